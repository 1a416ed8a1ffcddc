"""One HTML page about a comparison that needs no network: verdict, signals, blocks, where, diagnostics, scatter."""
from __future__ import annotations

from typing import Any

from fdi.comparison.compare import Comparison
from fdi.report import compare_figures as figures
from fdi.report.compare_text import SHOWN, amount, block_word, digits, lines, sentence
from fdi.report.html import load_templates

MOODS = {"WITHIN_FLOOR": "good", "MODEL_INCOMPLETE": "bad", "CANNOT_TELL": "doubtful"}
ELSEWHERE = ("where", "note")  # labels of lines that have a place of their own on the page


def render(found: Comparison) -> str:
    """The page as text."""
    return load_templates().get_template("compare.html").render(
        title=found.source, verdict=found.verdict, mood=MOODS[found.verdict], why=sentence(found),
        facts=_facts(found), signals=[_signal(found, name) for name in found.signals],
        blocks=[_block(found, name) for name in found.blocks],
        lines=[(label, text) for label, text in lines(found) if label not in ELSEWHERE], notes=found.notes,
        overview=figures.overview(found), shares=figures.shares(found) if found.where else "",
        where=[{"section": p.section, "t": f"{p.t0:.2f} – {p.t1:.2f} s", "share": f"{100 * p.share:.1f} %",
                "ratio": digits(p.ratio), "condition": p.condition} for p in found.where],
        whiteness=figures.whiteness(found), dependence=figures.dependence(found),
        scatter=[(name, f"{moved:+.2f}") for name, moved in found.scatter.moved.items()] if found.scatter else [],
        changes=sorted(found.model.differences().items()))


def _facts(found: Comparison) -> list[tuple[str, str]]:
    c = found.trace
    length = f"{len(c) * c.period:.3f} s, {len(c)} cycles of {1e3 * c.period:g} ms"
    return [("model", found.model.name), ("trace", length),
            ("repeats", str(found.repeats)), ("signals", ", ".join(SHOWN[name][0] for name in c.outputs))]


def _signal(found: Comparison, name: str) -> dict[str, Any]:
    s = found.signals[name]
    return {"name": SHOWN[name][0], "error": amount(s.error, name), "ratio": digits(s.ratio), "over": s.ratio > s.limit,
            "floor": ("≥ " if s.floor.lower_bound else "") + amount(s.floor.value, name), "source": s.floor.source,
            "closed": amount(s.closed_loop_error, name), "solver": amount(s.solver_error, name)}


def _block(found: Comparison, name: str) -> dict[str, Any]:
    ratio = found.blocks[name]
    return {"name": name, "ratio": "–" if ratio is None else digits(ratio), "known": ratio is not None,
            "over": name in found.named, "word": block_word(found, name)}

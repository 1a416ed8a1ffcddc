"""Print the tables of a campaign in Markdown, and draw its figure: python -m studies.fdi_statistics FOLDER ..

The first campaign gives all tables, further ones their rates only.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi.diagnosis.faults import FAULTS
from rig.campaign.judge import read_campaign_rows, read_matrix_of_folder
from rig.campaign.summary import draw_detection_curves, format_requirement, show_share, summarise_campaign

FIGURE = Path(__file__).parent.parent / "docs" / "fdi_statistics.svg"
MET = {None: "", True: "met", False: "**not met**"}


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines) + "\n"


def format_rates(rates: Sequence[Mapping[str, Any]]) -> str:
    """The required rates as a table."""
    return format_table(("", "count", "share", "95 % interval", "required", ""),
                        [(r["name"].strip(), *show_share(r["share"]),
                          format_requirement(100 * r["least"], 100 * r["most"]), MET[r["met"]])
                         for r in rates if r["share"]["of"]])


def format_tolerance(figures: Mapping[str, Any]) -> str:
    """All tables of the cases with one tolerance."""
    out = f"## Plants with {100 * figures['tolerance']:g} % scatter: {figures['cases']} cases\n\n"
    out += format_rates(figures["rates"])
    for fault in FAULTS:
        points = figures["curves"][fault.name]
        if len(points) > 1:
            out += format_table((fault.symbol, "maintenance or worse", "share", "95 % interval", "non-nominal",
                                 "ruling", "by the bands alone"),
                                [(f"{p['size']:g}", *show_share(p["detected"]),
                                  *(show_share(p[key])[1] for key in ("most", "ruling", "bands"))) for p in points])
    for fault in FAULTS:
        counts = figures["levels"][fault.name]
        words = [word for word in next(iter(counts.values())) if any(row[word] for row in counts.values())]
        out += format_table((f"{fault.symbol}: true level, reported", *words),
                     [(name, *(str(row[word]) for word in words)) for name, row in counts.items() if any(row.values())])
    words = sorted({word for row in figures["ruling"].values() for word in row})
    out += format_table(("ruling fault: truth, reported", *words),
                 [(name, *(str(row.get(word, 0)) for word in words)) for name, row in figures["ruling"].items()])
    return out + format_table(
        ("plant", "estimate of", "cases", "bias", "RMS error", "95 % within", "truth in its interval", "95 % interval"),
        [(e["label"](next(f for f in FAULTS if f.name == e["fault"])), str(e["cases"]),
          *(f"{e[key]:.2g}" for key in ("bias", "rms", "most")), *show_share(e["covered"])[1:])
         for e in figures["errors"]])


def format_other_campaign(folder: str) -> str:
    """The required rates of a further campaign."""
    figures = summarise_campaign(read_campaign_rows(folder))
    out = f"## Truth by the {read_matrix_of_folder(folder).spec['simulator']} simulator: {figures['cases']} cases\n\n"
    return out + "".join(f"{100 * of['tolerance']:g} % scatter, {of['cases']} cases\n\n{format_rates(of['rates'])}"
                         for of in reversed(figures["tolerances"]))


def main(folder: str, *others: str) -> None:
    """Print the tables and write the figure of docs/statistics.md."""
    figures = summarise_campaign(read_campaign_rows(folder))
    took, status = figures["seconds"], ", ".join(f"{n} {word}" for word, n in figures["status"].items())
    times = f"{took['median']:.1f} s (median), {took['p95']:.1f} s (95th percentile), {took['most']:.1f} s (longest)"
    text = f"{figures['cases']} cases: {status}. Time per trace on one core, beside other work: {times}.\n\n"
    text += "".join(format_tolerance(of) for of in reversed(figures["tolerances"]))
    text += "".join(map(format_other_campaign, others))
    for reason in figures["reasons"]:
        text += f"{reason['status']}: {reason['case']}, seed {reason['seed']}: {reason['reason']}\n\n"
    print(text)
    curves = max(figures["tolerances"], key=lambda of: sum(map(len, of["curves"].values())))
    FIGURE.write_text(draw_detection_curves(curves), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])

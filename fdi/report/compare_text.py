"""A comparison in words, for terminal and page, and as JSON (docs/json.md)."""
from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fdi.comparison.compare import BALANCED, BLOCK, Comparison, SignalError
from fdi.comparison.controller_block import DISAGREES
from fdi.comparison.residual_tests import LEAST_SHARE, ResidualTests

SHOWN = {"xj": ("XJ", "um", 1e6), "p12": ("P12", "bar", 1e-5), "xs": ("XS", "um", 1e6)}
BLOCKS = {
    "controller": "Com and XJ to Cor",
    "servovalve": "Cor to XS",
    "jack": "XS and P12 to the ram",
    "sensor": "the ram's flow to XJ",
}
WHOLE_VALVE = "Cor to flow, as XS was not measured"
STRONG = 0.15  # a correlation below that explains 1 % of the power and is not worth a word
LONG = 3.0  # times the noise's own memory
NOTABLE = 0.005  # of the ram's way
PLACES = 3  # sections in the text; the page and the JSON have all


def amount(value: float, name: str) -> str:
    """An SI value of a signal in the unit that people use.

    >>> amount(2.649e-4, "xj"), amount(3.77e5, "p12")
    ('265 um', '3.77 bar')
    """
    _, unit, scale = SHOWN[name]
    x = value * scale
    if unit == "um" and abs(x) >= 1000:
        x, unit = x / 1000, "mm"
    return f"{digits(x)} {unit}"


def digits(x: float) -> str:
    """Three digits without an exponent."""
    if not math.isfinite(x):
        return "-"
    if x == 0.0:
        return "0"
    return f"{x:.{min(3, max(0, 2 - math.floor(math.log10(abs(x)))))}f}"


def sentence(found: Comparison) -> str:
    """The verdict in plain words."""
    worst = max(found.signals.values(), key=lambda s: s.ratio)
    if found.verdict == "WITHIN_FLOOR":
        left = ", ".join(f"{SHOWN[s.name][0]} {amount(s.error, s.name)}" for s in found.signals.values())
        return f"The model explains this trace: what is left is noise ({left})."
    if found.verdict == "CANNOT_TELL":
        return f"This comparison cannot tell: {found.reason}."
    if found.named == ("controller",) and worst.ratio <= worst.limit:
        return "The plant fits, but the controller answers otherwise than the model's."
    said = (f"The model leaves {amount(worst.error, worst.name)} in {SHOWN[worst.name][0]} where noise explains "
            f"{amount(worst.floor.value, worst.name)}")
    return f"{said}; {_blame(found)}." if found.model.plant == BALANCED else f"{said}."


def _blame(found: Comparison) -> str:
    fits = [name for name, ratio in found.blocks.items() if ratio is not None and name not in found.named]
    if not found.named:
        return "P12 or XS would show in which block" if set(found.signals) == {"xj"} else "no block stands out"
    names = list(found.named)
    if found.blocks["jack"] is not None and found.blocks["jack"] == found.blocks["sensor"] and "jack" in names:
        names[names.index("jack")] = "jack or the sensor"
        names.remove("sensor")
    said = f"the {names[0]} disagree{'s' if ' or ' not in names[0] else ''}"
    if len(names) > 1:
        said += f", and less the {' and the '.join(names[1:])}"
    return said + (f"; {listed(fits)} fit" + ("s" if len(fits) == 1 else "") if fits else "")


def listed(words: list[str]) -> str:
    """Words with commas and an 'and'."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def block_word(found: Comparison, name: str) -> str:
    """What a block's ratio was made of."""
    if name == "controller":
        return _controller(found) if found.blocks[name] is not None else f"{BLOCKS[name]}: the firmware is not known"
    there = [SHOWN[s][0] for s in ("xs", "p12") if s in found.signals]
    said = BLOCKS[name]
    if found.blocks[name] is None:
        return f"{said}: " + ("too little of it to tell" if len(there) == 2 else
                              f"needs {'XS or P12' if not there else 'XS' if there == ['P12'] else 'P12'}")
    flow, force = found.parts["flow"], found.parts["force"]
    if name == "servovalve" and "XS" not in there:
        said = WHOLE_VALVE
    if name == "jack" and len(there) == 1:
        said = f"{there[0]} to the ram: {'flow' if there == ['XS'] else 'forces'}"
    elif name == "jack" and flow is not None and force is not None:
        said += f": flow {digits(flow)}, forces {digits(force)}"
    return said


def _controller(found: Comparison) -> str:
    a = found.answer
    late = [f"{name} of {lag} cycle{'s' if lag > 1 else ''} before" for name, lag in
            (("Com", a.com_lag), ("XJ", a.xj_lag)) if lag > 0]
    said = BLOCKS["controller"] + (f" ({' and '.join(late)})" if late else "")
    if a.ratio <= DISAGREES:
        return said + ": equal to the last digit"
    gain = found.model["controller.proportional_gain"]
    other = f"; it answers with {a.gain:.4g} A/m, the model with {gain:.4g}" \
        if math.isfinite(a.gain) and abs(a.gain / gain - 1) > 0.002 else ""
    return f"{said}: off by {1e6 * a.error:.3g} uA RMS{other}"


def floor_word(found: Comparison) -> str:
    """Where the floor is from."""
    sources = {s.floor.source for s in found.signals.values()}
    words = {"repeats": f"from {found.repeats} repeat{'s' if found.repeats != 1 else ''} of the test",
             "model": "the model's sensor noise; a repeat would measure it (--repeat)",
             "data": "second differences of the data, a lower bound; a repeat would measure it (--repeat)"}
    return "; ".join(words[source] for source in words if source in sources)


def lines(found: Comparison) -> list[tuple[str, str]]:
    """What else there is to say: (label, text) each."""
    out = [("floor", floor_word(found)), ("solver", _solver(found))]
    if found.verdict != "WITHIN_FLOOR":
        shown = [p for p in found.where if p.share > 0.05][:PLACES]
        for place in shown:
            much = f"{100 * place.share:.0f} % of the squared error, {digits(place.ratio)} floors"
            text = f"{place.section}, {place.t0:.2f}-{place.t1:.2f} s: {much}"
            out.append(("where", text + (f"; {place.condition}" if place.condition else "")))
        if found.condition:
            out.append(("when", found.condition))
    flow, gain = found.parts["flow"], found.parts["gain"]
    if flow is not None and gain is not None and flow > BLOCK and abs(gain) > NOTABLE:
        way = "further" if gain > 0 else "less"
        out.append(("flow", f"the ram moves {100 * abs(gain):.2g} % {way} than the flow through the edges says"))
    slope = found.drift * 1e6
    if "xj" in found.signals and abs(slope) > 1.0 and not found.trace.filled.any():
        out.append(("drift", f"a replay not held to the measured position departs by {slope:.3g} um/s"))
    out += [("residual", f"{SHOWN[name][0]}: {text}") for name, text in _residuals(found)]
    if found.scatter is not None:
        out.append(("scatter", _scatter(found)))
    return out + [("note", note) for note in found.notes]


def _solver(found: Comparison) -> str:
    parts = [f"{SHOWN[s.name][0]} {amount(s.solver_error, s.name)}" for s in found.signals.values()]
    step = 1e6 * found.trace.period / found.replay.steps
    return f"halving the step to {step:g} us moves {', '.join(parts)}"


def _scatter(found: Comparison) -> str:
    s = found.scatter
    assert s is not None
    most = [f"{name} by {moved:+.1f}" for name, moved in s.moved.items() if abs(moved) > 1.0][:2]
    worst = max(s.ratio, key=lambda name: s.ratio[name])
    if s.enough:
        return ("differences from unit to unit within the parameters' tolerances could explain all of it"
                + (f" (in tolerances: {', '.join(most)})" if most else ""))
    return (f"tolerances do not explain it: refitted within them the model still leaves "
            f"{amount(s.error[worst], worst)} in {SHOWN[worst][0]}, {digits(s.ratio[worst])} floors")


def _residuals(found: Comparison) -> list[tuple[str, str]]:
    """One line a signal that is above its floor."""
    out = []
    for name, d in found.diagnoses.items():
        if found.signals[name].ratio > found.signals[name].limit and (said := _diagnosis(name, d)):
            out.append((name, "; ".join(said)))
    return out


def _diagnosis(name: str, d: ResidualTests) -> list[str]:
    said = []
    if d.memory > LONG * d.noise_memory:
        said.append(f"keeps its sign for {1e3 * d.memory:.0f} ms (noise {1e3 * d.noise_memory:.0f} ms), "
                    f"half of it below {d.half_power:.2g} Hz")
    strong = [f for f in d.follows if abs(f.correlation) > max(STRONG, 2 * f.bound)]
    if strong:
        f = max(strong, key=lambda f: abs(f.correlation))
        said.append(f"moves {1e3 * f.lag:.3g} ms after {f.input} (correlation {f.correlation:.2f})")
    if d.depends and d.depends[0].share > LEAST_SHARE:
        most = d.depends[0]
        shape = f", {most.shape} it" if most.shape else ""
        said.append(f"{100 * most.share:.0f} % of it goes with {most.on}{shape}, up to {amount(most.size, name)}")
    return said


def to_json(found: Comparison) -> dict[str, Any]:
    """The answer of `rig compare --json`; SI units, null for what cannot be told."""
    return {
        "verdict": found.verdict, "reason": found.reason or sentence(found), "trace": found.source,
        "model": found.model.name,
        "signals": {name: _signal(s) for name, s in found.signals.items()},
        "solver_error": number(found.signals["xj"].solver_error) if "xj" in found.signals else None,
        "steps": found.replay.steps,
        "where": [{"section": p.section, "t0": number(p.t0), "t1": number(p.t1), "share": number(p.share),
                   "ratio": number(p.ratio), "condition": p.condition} for p in found.where],
        "condition": found.condition,
        "blocks": {name: number(ratio) for name, ratio in found.blocks.items()},
        "disagree": list(found.named),
        "parts": {name: number(value) for name, value in found.parts.items()},
        "controller": {"error": number(found.answer.error), "floor": number(found.answer.floor),
                       "com_lag": found.answer.com_lag, "xj_lag": found.answer.xj_lag,
                       "gain": number(found.answer.gain)},
        "drift": {"speed": number(found.drift), "free_error": number(found.free_error)},
        "tolerances": _tolerances(found),
        "diagnostics": {name: _numbers(d) for name, d in found.diagnoses.items()},
        "repeats": found.repeats, "notes": list(found.notes)}


def _signal(s: SignalError) -> dict[str, Any]:
    return {"unit": s.unit, "error": number(s.error), "floor": number(s.floor.value), "ratio": number(s.ratio),
            "closed_loop_error": number(s.closed_loop_error), "solver_error": number(s.solver_error),
            "limit": number(s.limit), "floor_source": s.floor.source, "lower_bound": s.floor.lower_bound,
            "hum": number(s.floor.hum), "difference": number(s.floor.difference)}


def _tolerances(found: Comparison) -> dict[str, Any] | None:
    s = found.scatter
    if s is None:
        return None
    return {"enough": s.enough, "error": numbers(s.error), "ratio": numbers(s.ratio), "moved": numbers(s.moved)}


def _numbers(d: ResidualTests) -> dict[str, Any]:
    return {"memory": number(d.memory), "noise_memory": number(d.noise_memory), "half_power": number(d.half_power),
            "periodogram": {"distance": number(d.departs), "band": number(d.allowed)},
            "autocorrelation": {"lag_1": number(float(d.correlation[1])), "band": number(d.band)},
            "inputs": {f.input: {"correlation": number(f.correlation), "lag": number(f.lag), "bound": number(f.bound)}
                       for f in d.follows},
            "depends_on": [{"on": x.on, "share": number(x.share), "shape": x.shape, "size": number(x.size)}
                           for x in d.depends]}


def numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    """Each value as JSON has it."""
    return {name: number(value) for name, value in values.items()}


def number(value: float | None) -> float | None:
    """A finite number, else null: JSON has neither NaN nor infinity."""
    return None if value is None or not math.isfinite(value) else float(value)

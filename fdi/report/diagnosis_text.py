"""A diagnosis in plain words and as JSON."""
from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fdi.diagnosis.diagnosis import Diagnosis
from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Estimate, Fault, Level
from fdi.diagnosis.levels import severity

NAMES = {CLOGGING.name: "filter clogging", FRICTION.name: "spool friction"}
LEVELS = {Level.ACCEPTABLE: "acceptable", Level.MAINTENANCE: "maintenance", Level.NON_NOMINAL: "non-nominal",
          None: "cannot be judged"}
NEEDS: Mapping[Level | None, str] = {Level.MAINTENANCE: "requires maintenance", Level.NON_NOMINAL: "is non-nominal"}
SUSPECTS = {
    "jack.dynamic_friction": ("jack friction", "N", 1.0), "jack.damping": ("viscous drag of the jack", "N s/m", 1.0),
    "jack.mass": ("moving mass", "kg", 1.0), "jack.leakage": ("leakage across the piston", "m3/s/Pa", 1.0),
    "null_bias.current": ("null bias", "mA", 1e3), "constant_load.force": ("a load that was not measured", "N", 1.0),
}
SHOWN = {"xj": "XJ", "p12": "P12", "xs": "XS"}


def sentence(d: Diagnosis) -> str:
    """The verdict in a sentence or two."""
    if d.verdict == "SOMETHING_ELSE":
        return (f"Neither fault explains this trace: {left_over(d)}. Something else is wrong, and no fault is blamed "
                "before it is known what.")
    if d.verdict == "CANNOT_TELL":
        unknown = " and ".join(NAMES[name] for name, found in d.levels.items() if found is None)
        return f"This trace does not tell {unknown}: a healthy unit and MidBand are both within the interval."
    if d.verdict == "ACCEPTABLE":
        return "Both faults are acceptable." + _besides(d)
    worst = next(f for f in FAULTS if f.name == d.ruling)
    others = [f for f in FAULTS if f.name != d.ruling]
    rest = "; ".join(f"{NAMES[f.name]} {LEVELS[d.levels[f.name]]}" for f in others)
    return f"{NAMES[worst.name].capitalize()} {NEEDS[d.levels[worst.name]]}: {told(worst, d.sizes[worst.name])}; " \
           f"{rest}." + _besides(d)


def left_over(d: Diagnosis) -> str:
    """What the best fit leaves, in floors."""
    found = ", ".join(f"{SHOWN[s]} {ratio:.3g}" for s, ratio in d.refined.ratio.items())
    return f"the best fit leaves {found} times what noise explains"


def overruled(d: Diagnosis) -> list[str]:
    """Why a fault is judged better than the bands say, fault by fault."""
    said = []
    for f in FAULTS:
        banded, level = d.judged.levels.get(f.name) if d.judged else None, d.levels[f.name]
        if banded is not None and level is not None and banded > level:
            why = "; ".join(besides(name, e) for name, e in d.others.items())
            said.append(f"call {NAMES[f.name]} {LEVELS[banded]}; the fit, which knows more of the plant, finds it "
                        f"{LEVELS[level]}" + (f", beside {why}" if why else ""))
    return said


def _besides(d: Diagnosis) -> str:
    """What is off besides the two faults."""
    if not d.others:
        return ""
    return " Besides: " + "; ".join(besides(name, e) for name, e in d.others.items()) + "."


def besides(name: str, e: Estimate) -> str:
    """A suspect that is off, with its interval."""
    words, unit, scale = SUSPECTS[name]
    return f"{words} {scale * e.value:.3g} {unit} ({scale * e.low:.3g} .. {scale * e.high:.3g})"


def told(fault: Fault, e: Estimate) -> str:
    """A size with its interval and what it is held against.

    >>> told(CLOGGING, Estimate(0.2512, 0.204, 0.299))
    'Kintas 0.251 (0.204 .. 0.299), MidBand 0.25, MaxBand 0.35'
    """
    unit = "" if fault.unit == "1" else f" {fault.unit}"
    symbol = {"kintas": "Kintas", "fss": "FSS"}[fault.symbol]
    return f"{symbol} {size(e.value)} ({size(e.low)} .. {size(e.high)}){unit}, " \
           f"MidBand {fault.middle:g}{unit}, MaxBand {fault.most:g}{unit}"


def size(x: float) -> str:
    """Three digits."""
    return f"{x:.3f}" if abs(x) < 1.0 else f"{x:.3g}"


def to_json(d: Diagnosis) -> dict[str, Any]:
    """What `rig fdi --json` prints; SI units."""
    g, r = d.grid, d.refined
    return {
        "verdict": d.verdict, "sentence": sentence(d),
        "level": {name: found.word if found is not None else None for name, found in d.levels.items()},
        "ruling": d.ruling,
        "severity": {f.name: severity(f, d.sizes[f.name].value) for f in FAULTS},
        "events": [e._asdict() for e in d.events],
        "bands": {"level": {name: found.word for name, found in d.judged.levels.items()}, "ruling": d.judged.ruling}
        if d.judged else None,
        "precursors": {name: {key: _number(value) for key, value in p._asdict().items()}
                       for name, p in d.precursors.items()},
        "grid": {"step": _point(g.step and g.step.minimum), "ramp": _point(g.ramp and g.ramp.minimum),
                 "joint": _point(g.joint.minimum), "merged": g.merged._asdict(), "simulations": g.simulations}
        if g else None,
        "refined": {"kintas": d.sizes[CLOGGING.name]._asdict(), "fss": d.sizes[FRICTION.name]._asdict(),
                    "correlation": r.correlation, "method": r.method, "simulations": r.simulations,
                    "reached": r.reached},
        "signals": {s: {"error": r.errors[s], "floor": r.floor[s], "ratio": r.ratio[s]} for s in r.errors},
        "others": {name: {**e._asdict(), "unhealthy": name in d.others} for name, e in r.others.items()},
        "notes": list(d.notes),
    }


def _point(p: Any) -> dict[str, float] | None:
    return dict(p._asdict()) if p else None


def _number(x: Any) -> Any:
    """JSON knows no NaN."""
    return None if isinstance(x, float) and not math.isfinite(x) else x


def levels_of(d: Diagnosis) -> Mapping[str, str]:
    """The levels in words, by fault."""
    return {name: LEVELS[found] for name, found in d.levels.items()}

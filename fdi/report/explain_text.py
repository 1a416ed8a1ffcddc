"""An explanation in plain words: one sentence, and lines of what else there is to know."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from fdi.discovery.candidates import Answer, Blind, Candidate, Suspicious, Value
from fdi.report.numbers import (
    SIGNAL_NAMES,
    SIGNAL_UNITS,
    format_amount,
    format_interval,
    format_signals,
    join_words,
    name_parameter,
)

SPOKEN = 2  # parameters of an effect in a sentence
FEWEST = 4  # blind spots, or suspicious parameters, that are listed by name


def sentence(a: Answer) -> str:
    """The verdict."""
    return {"NOTHING_MISSING": _nothing, "EXPLAINED": _explained, "AMBIGUOUS": _ambiguous, "PARTLY": _partly,
            "UNEXPLAINED": _unexplained, "NOT_RESOLVABLE": _unresolved}[a.verdict](a)


def _nothing(a: Answer) -> str:
    return f"Nothing is missing: what is left is noise ({format_signals(a.baseline['error'])})."


def _explained(a: Answer) -> str:
    named = [c for c in a.candidates if c.effect in a.explanation.effects]
    said = f"{join_words(c.effect for c in named)} {'explain it together' if len(named) > 1 else 'explains it'}: "
    return f"{said}{'; '.join(_sizes(c) for c in named)}; {_change(a, named[-1])}."


def _ambiguous(a: Answer) -> str:
    return f"{join_words(a.explanation.effects, 'or')}: each explains it, and these data cannot tell which; " \
           f"{_change(a, a.candidates[0])}."


def _partly(a: Answer) -> str:
    named = [c for c in a.candidates if c.effect in a.explanation.effects]
    if not named:
        return _unexplained(a)
    said = f"{join_words(c.effect for c in named)} {'explain' if len(named) > 1 else 'explains'} a part: "
    return f"{said}{'; '.join(_sizes(c) for c in named)}; {_change(a, named[-1])}. Something else is missing."


def _unexplained(a: Answer) -> str:
    worst = _worst(a)
    if _firmware_left(a):
        return "The firmware answers otherwise than the model's, and no effect of the catalogue explains how."
    error, floor = (_amount(a.baseline[which], worst) for which in ("error", "floor"))
    said = f"Nothing in the catalogue explains it: error of {SIGNAL_NAMES[worst]} {error} where noise leaves {floor}"
    best = min(a.candidates, key=lambda c: c.ratio, default=None)
    return f"{said}; {best.effect} does best and leaves {_amount(best.error, worst)}." if best else f"{said}."


def _unresolved(a: Answer) -> str:
    c = a.candidates[0]
    return f"The error is at the floor ({format_signals(a.baseline['error'])}). {c.effect} may be there " \
           f"({_sizes(c)}), too small in this test to be sure."


def _firmware_left(a: Answer) -> bool:
    return a.explanation.base.reached and not a.explanation.effects


def _sizes(c: Candidate) -> str:
    return ", ".join(value(name, v) for name, v in list(c.parameters.items())[:SPOKEN])


def value(name: str, v: Value) -> str:
    """A parameter with its interval."""
    return f"{name_parameter(name)} {format_interval(v.value, v.low, v.high, v.unit)}"


def _worst(a: Answer) -> str:
    """The signal that the model without further effects explains worst."""
    error, floor = a.baseline["error"], a.baseline["floor"]
    return max(error, key=lambda s: error[s] / floor[s] if floor.get(s) else 0.0)


def _change(a: Answer, c: Candidate) -> str:
    """Error before and after, floor, held-out run."""
    s = _worst(a)
    said = f"error of {SIGNAL_NAMES[s]} {_amount(a.baseline['error'], s)} -> {_amount(c.error, s)}, floor " \
           f"{_amount(a.baseline['floor'], s)}"
    return said + (f"; on the held-out run {_amount(c.holdout, s)}" if s in c.holdout else "")


def _amount(by: Mapping[str, float], signal: str) -> str:
    return format_amount(by.get(signal, math.nan), SIGNAL_UNITS[signal])


def lines(a: Answer) -> list[tuple[str, str]]:
    """(label, text) of what else there is to know."""
    found = []
    if a.separate:
        said = f"{a.separate['by']}: in simulation that tells {join_words(a.separate['between'])} apart"
        found.append(("to split", said))
    elif a.verdict == "AMBIGUOUS":
        found.append(("to split", "no sensor and no command that was tried tells them apart"))
    if a.pattern:
        found.append(("left over", a.pattern))
    if a.suspicious:
        found.append(("suspicious", suspicious(a.suspicious)))
    return [*found, ("blind to", blind(a))]


def suspicious(found: Sequence[Suspicious]) -> str:
    """Parameters that are off by more than units differ."""
    worst = sorted(found, key=lambda s: -abs(s.tolerances))
    said = [f"{s.parameter} {format_amount(s.value, s.unit)} ({s.tolerances:+.1f} tolerances)" for s in worst[:FEWEST]]
    more = f" and {len(worst) - FEWEST} more" if len(worst) > FEWEST else ""
    return f"{', '.join(said)}{more}, further off than a healthy unit has them"


def blind(a: Answer) -> str:
    """What this test would not have seen, and how much it would."""
    unseen = [b for b in a.blind if not b.smallest <= b.usual]
    seen = len(a.blind) - len(unseen) + len(a.noiseless)
    named = join_words(_below(b) for b in unseen[:FEWEST])
    more = f" and {len(unseen) - FEWEST} more" if len(unseen) > FEWEST else ""
    return f"{named + more if unseen else 'nothing of usual size'}; {seen} other effects would have been seen"


def _below(b: Blind) -> str:
    size = "any size" if math.isinf(b.smallest) else f"below {format_amount(b.smallest, b.unit)}"
    return f"{b.effect} ({size})"

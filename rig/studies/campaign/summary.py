"""The statistics of a campaign: false alarms, missed faults by size, confusion, errors, coverage; all with counts."""
from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Fault, Level
from fdi.diagnosis.levels import of_value
from fdi.estimation.binomial import Share, share
from rig.studies.campaign.case import FAILED, OK, REFUSED, Row
from rig.studies.campaign.judge import CANNOT_TELL
from rig.studies.campaign.matrix import HEALTHY, label

OFF_GRID = label({"filter_clogging": 0.17, "spool_friction": 45.0})
"""The paper's second worked case, which no cell of a 21 x 21 grid hits."""
CLOSE = {CLOGGING.name: 0.05, FRICTION.name: 0.02}  # relative error asked of it
FEWEST = 20  # cases; of less no rate is judged, nor where one case is more than what is allowed
LEVELS = [level.word for level in Level]


class Rate(NamedTuple):
    """A share that is asked for, and what was found."""

    name: str
    share: Share
    least: float = 0.0  # asked
    most: float = 1.0  # asked; 0 to 1 is not asked, but told

    @property
    def met(self) -> bool | None:
        """Whether it is what was asked for; None where nothing is asked, or so few were counted that one would decide.

        Few are enough where even the interval is outside.
        """
        if (self.least, self.most) == (0.0, 1.0) or not self.share.of:
            return None
        allowed = self.most if self.least == 0.0 else 1.0 - self.least if self.most == 1.0 else self.most - self.least
        outside = self.share.low > self.most or self.share.high < self.least
        enough = self.share.of >= max(FEWEST, round(1.0 / allowed))
        return self.least <= self.share.value <= self.most if enough or outside else None


class Point(NamedTuple):
    """How often a single fault of one size is detected."""

    size: float
    detected: Share  # level beyond acceptable
    most: Share  # level non-nominal
    ruling: Share  # named as the ruling fault
    bands: Share  # beyond acceptable by the bands alone


class Error(NamedTuple):
    """How far the estimates of one fault are off, over the cases of one label that have them."""

    label: str
    fault: str
    truth: float
    cases: int
    bias: float
    rms: float
    most: float  # 95 of 100 are no further off
    close: Share | None  # as close as is asked of the off-grid case
    covered: Share  # 95 % interval holds the truth


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """All figures as JSON values: by tolerance for simulated plants, in short for recorded traces.

    A case that was refused or failed detects nothing; it is never counted as a false alarm, but beside them. Of another
    judgement than that of `rig fdi`, which names no levels, only status and time are told.
    """
    levelled = [row for row in rows if row["status"] != OK or f"level_{CLOGGING.name}" in row]
    simulated = [row for row in levelled if "true_fss" in row]
    tolerances = sorted({row["tolerance"] for row in simulated})
    return {"cases": len(rows), "status": dict(Counter(row["status"] for row in rows)), "seconds": seconds(rows),
            "tolerances": [_of(t, [r for r in simulated if r["tolerance"] == t]) for t in tolerances],
            "traces": [_trace(row) for row in levelled if "true_fss" not in row],
            "reasons": [{"case": row["label"], "seed": row["seed"], "status": row["status"], "reason": row["reason"]}
                        for row in rows if row["status"] != OK]}


def _of(tolerance: float, rows: Sequence[Row]) -> dict[str, Any]:
    return {"tolerance": tolerance, "cases": len(rows),
            "rates": [_json(rate) | {"met": rate.met} for rate in rates(rows)],
            "curves": {fault.name: [_json(point) for point in curve(rows, fault)] for fault in FAULTS},
            "levels": {fault.name: levels(rows, fault) for fault in FAULTS},
            "ruling": ruling(rows),
            "errors": [_json(error) for error in errors(rows)],
            "false_alarms": [{key: row.get(key) for key in ("seed", "verdict", *(f"level_{f.name}" for f in FAULTS))}
                             for row in rows if row["label"] == HEALTHY and alarm(row)]}


def _trace(row: Row) -> dict[str, Any]:
    names = ("label", "status", "ruling", *(f"level_{f.name}" for f in FAULTS), "kintas", "fss", "trust")
    return {name: row.get(name) for name in names}


def rates(rows: Sequence[Row]) -> list[Rate]:
    """What is asked for, with counts."""
    healthy = [row for row in rows if row["label"] == HEALTHY and row["status"] == OK]
    out = [Rate("healthy: false alarm", counted(healthy, alarm), most=0.005),
           Rate("  event outside a band", counted(healthy, lambda row: bool(row.get("event_count")))),
           Rate("  judged acceptable", counted(healthy, lambda row: row.get("verdict") == "ACCEPTABLE"))]
    for fault in FAULTS:
        for word, least, size in (("MidBand", 0.95, fault.middle), ("MaxBand", 0.995, fault.most)):
            of = [row for row in single(rows, fault) if truth(row, fault) == size]
            out.append(Rate(f"{title(fault)} at {word} detected", counted(of, detects(fault)), least))
    beyond = [(row, fault) for fault in FAULTS for row in single(rows, fault) if truth(row, fault) >= fault.middle]
    out.append(Rate("ruling fault, MidBand on",
                    share(sum(row.get("ruling") == fault.name for row, fault in beyond), len(beyond)), 0.97))
    return [*out, *_covered(rows), *_off_grid([row for row in rows if row["label"] == OFF_GRID])]


def _covered(rows: Sequence[Row]) -> list[Rate]:
    """Over all plants that scatter; not where the truth is a bound: an interval that starts there holds it."""
    out = []
    for fault in FAULTS:
        of = [e.covered for e in errors([row for row in rows if row["tolerance"] > 0.0])
              if e.fault == fault.name and e.truth > 0.0]
        out.append(Rate(f"{title(fault)} covered, all", share(sum(c.good for c in of), sum(c.of for c in of))))
    return out


def _off_grid(rows: Sequence[Row]) -> list[Rate]:
    """Of the plant as the model has it the estimates are to be close, of one that scatters their intervals right."""
    out = []
    for error in errors(rows):
        name = title(next(fault for fault in FAULTS if fault.name == error.fault))
        exact = rows[0]["tolerance"] == 0.0
        if error.close is not None:
            out.append(Rate(f"off-grid {name} within {100 * CLOSE[error.fault]:g} %", error.close,
                            0.95 if exact else 0.0))
        out.append(Rate(f"off-grid {name} covered", error.covered,
                        *((0.0, 1.0) if exact else (0.93, 0.97))))
    return out


def title(fault: Fault) -> str:
    """The symbol of a fault's size as the paper writes it."""
    return {"kintas": "Kintas"}.get(fault.symbol, fault.symbol.upper())


def counted(rows: Iterable[Row], good: Callable[[Row], bool]) -> Share:
    """How many rows are good."""
    judged = [good(row) for row in rows]
    return share(sum(judged), len(judged))


def alarm(row: Row) -> bool:
    """Whether any fault is said to be beyond acceptable, or that something else is wrong."""
    return any(detects(fault)(row) for fault in FAULTS) or row.get("verdict") == "SOMETHING_ELSE"


def detects(fault: Fault, level: Level = Level.MAINTENANCE, by: str = "level") -> Callable[[Row], bool]:
    """Whether a row says that a fault has reached a level; `by` the sizes ("level") or the bands alone ("band")."""
    return lambda row: row["status"] == OK and row.get(f"{by}_{fault.name}") in LEVELS[level:]


def single(rows: Iterable[Row], fault: Fault) -> list[Row]:
    """The rows of plants with this fault and no other."""
    return [row for row in rows if row["faults"] == 1 and row["label"].startswith(f"{fault.name}=")]


def truth(row: Row, fault: Fault) -> float:
    """The true size, SI."""
    return float(row[f"true_{fault.symbol}"])


def curve(rows: Sequence[Row], fault: Fault) -> list[Point]:
    """Detection by size, small to large; the first point is the healthy plant."""
    of = [row for row in rows if row["label"] == HEALTHY and row["status"] == OK] + single(rows, fault)
    sizes = sorted({truth(row, fault) for row in of})
    groups = [(size, [row for row in of if truth(row, fault) == size]) for size in sizes]
    return [Point(size, counted(group, detects(fault)), counted(group, detects(fault, Level.NON_NOMINAL)),
                  counted(group, lambda row: row.get("ruling") == fault.name),
                  counted(group, detects(fault, by="band"))) for size, group in groups]


def levels(rows: Iterable[Row], fault: Fault) -> dict[str, dict[str, int]]:
    """True class to the level that was said, counts; of all plants with no fault but the two."""
    table = {level: dict.fromkeys([*LEVELS, CANNOT_TELL, REFUSED, FAILED], 0) for level in LEVELS}
    for row in rows:
        if not others(row):
            said = row[f"level_{fault.name}"] if row["status"] == OK else row["status"]
            table[of_value(fault, truth(row, fault)).word][said] += 1
    return table


def others(row: Row) -> bool:
    """Whether a plant has another fault than the two."""
    known = {fault.name for fault in FAULTS}
    return any(part.partition("=")[0] not in known for part in row["label"].split() if row["label"] != HEALTHY)


def ruling(rows: Iterable[Row]) -> dict[str, dict[str, int]]:
    """What plants have (fault and true class) to the ruling fault that was named, counts."""
    table: dict[str, Counter[str]] = {}
    for row in rows:
        said = row.get("ruling") or "none" if row["status"] == OK else row["status"]
        table.setdefault(_having(row), Counter())[said] += 1
    return {name: dict(table[name]) for name in sorted(table)}


def _having(row: Row) -> str:
    if row["label"] == HEALTHY:
        return HEALTHY
    names = [part.partition("=")[0] for part in row["label"].split()]
    if len(names) == 1 and not others(row):
        fault = next(fault for fault in FAULTS if fault.name == names[0])
        return f"{names[0]}, {of_value(fault, truth(row, fault)).word}"
    return " and ".join(names)


def errors(rows: Sequence[Row]) -> list[Error]:
    """Errors of the estimates by label and fault: healthy plants, single faults, both, each by size."""
    found = []
    sizes = {row["label"]: (row["faults"], row["true_kintas"] == 0.0, row["true_kintas"], row["true_fss"])
             for row in rows}
    for name in sorted(sizes, key=lambda name: (sizes[name], name)):
        for fault in FAULTS:
            of = [row for row in rows if row["label"] == name and row.get(f"{fault.symbol}_low") is not None
                  and row["status"] == OK and math.isfinite(row[f"{fault.symbol}_high"] - row[f"{fault.symbol}_low"])]
            if of and not others(of[0]):
                found.append(_error(name, of, fault))
    return found


def _error(name: str, rows: Sequence[Row], fault: Fault) -> Error:
    size = truth(rows[0], fault)
    off = np.array([row[fault.symbol] for row in rows]) - size
    within = share(int((abs(off) <= CLOSE[fault.name] * size).sum()), len(off)) if size > fault.healthy else None
    covered = counted(rows, lambda row: row[f"{fault.symbol}_low"] <= size <= row[f"{fault.symbol}_high"])
    return Error(name, fault.name, size, len(off), float(off.mean()), float(np.sqrt((off**2).mean())),
                 float(np.quantile(abs(off), 0.95)), within, covered)


def seconds(rows: Iterable[Row]) -> dict[str, float]:
    """Time a case took to be judged: median, 95 of 100, most; empty if none was."""
    took = [row["seconds"] for row in rows if "seconds" in row]
    if not took:
        return {}
    return {"median": float(np.median(took)), "p95": float(np.quantile(took, 0.95)), "most": max(took)}


def _json(record: Any) -> Any:
    """A record of records as JSON values; a share has its value beside its count."""
    if isinstance(record, Share):
        return {**record._asdict(), "share": record.value if record.of else None}
    if hasattr(record, "_asdict"):
        return {key: _json(value) for key, value in record._asdict().items()}
    return record

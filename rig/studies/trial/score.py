"""How often an explanation was right: the trial's records counted against the rates that are asked for."""
from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from plant.effects import CATALOGUE

Record = Mapping[str, Any]

VISIBLE = 2.0  # floors, from where on an effect has to be found
ADDED = 1.15  # floors, most that may be left on the hold-out with the right effect
TIME = 20.0  # s
CONFIDENCE = 0.95
JUDGED = "xj,p12,xs"
"""The signals of the cases that the rates are asked of; with fewer, more effects look alike."""


class Rate(NamedTuple):
    """A share that is asked for, and what was found."""

    name: str
    good: int
    of: int
    asked: float
    low: float  # exact binomial interval, 95 %
    high: float
    bad: tuple[int, ...]  # seeds

    @property
    def share(self) -> float:
        """Good ones of all; NaN where there was none."""
        return self.good / self.of if self.of else math.nan

    @property
    def met(self) -> bool:
        """Whether the share reaches what was asked for."""
        return self.of > 0 and self.share >= self.asked


def visible(record: Record, ratio: Mapping[str, float] | None = None) -> float:
    """What the hidden effects do, in floors, in the signal that shows them most of those the case has.

    The position counts by its differences over 20 cycles, because a replay drifts on anything; the answer always.
    """
    ratios = record["truth"]["base_ratio"] if ratio is None else ratio
    return max(ratios[name] for name in [*record["truth"]["signals"].split(","), "cor"])


def named(record: Record) -> bool:
    """Whether all that is hidden is among what is named."""
    return set(record["truth"]["effects"]) <= set(record["answer"]["effects"])


def covered(record: Record) -> bool | None:
    """Whether the interval of the hidden effect's first parameter holds the truth; None where there is no interval."""
    hidden = record["truth"]["hidden"][0]
    parameter = CATALOGUE[hidden["effect"]].fitted[0]
    found = _candidate(record, hidden["effect"]).get("parameters", {}).get(parameter)
    if found is None or found.get("low") is None or math.isnan(hidden["value"]):
        return None
    return bool(found["low"] <= hidden["value"] <= found["high"])


def held_out(record: Record) -> float | None:
    """Error on the hold-out with the right effect added, in floors, in the worst signal; None if not told."""
    floors = (record["answer"].get("baseline") or {}).get("floor") or {}
    errors = _candidate(record, record["truth"]["effects"][0]).get("holdout") or {}
    known = [errors[name] / floors[name] for name in errors if floors.get(name)]
    return max(known) if known else None


def _candidate(record: Record, effect: str) -> Mapping[str, Any]:
    found = [c for c in record["answer"].get("candidates", []) if c["effect"] == effect]
    return found[0] if found else {}


def _of(records: Iterable[Record], kind: str) -> list[Record]:
    return [r for r in records if r["truth"]["kind"] == kind]


def clear(records: Iterable[Record], kind: str) -> list[Record]:
    """Cases of a kind whose hidden effects, each of them, have to be found."""
    return [r for r in _of(records, kind) if visible(r) >= VISIBLE
            and all(visible(r, h["ratio"]) >= VISIBLE for h in r["truth"]["hidden"] if "ratio" in h)]


def rates(records: Sequence[Record]) -> list[Rate]:
    """The rates that are asked for, each with its count."""
    one, outside = clear(records, "one"), clear(records, "outside")
    right = [r for r in one if named(r)]
    return [
        _rate("nothing missing: NOTHING_MISSING", _of(records, "nothing"), 0.99, _verdict("NOTHING_MISSING")),
        _rate("one effect: the truth is named", one, 0.97, named),
        _rate("  its 95 % interval holds the truth", right, 0.90, covered),
        _rate("  hold-out at most 1.15 floors with it", right, 0.90, _within(held_out, ADDED)),
        _rate("outside the catalogue: UNEXPLAINED or PARTLY", outside, 0.95, _verdict("UNEXPLAINED", "PARTLY")),
        _rate("outside the catalogue: never EXPLAINED", _of(records, "outside"), 1.0,
              lambda r: r["answer"]["verdict"] != "EXPLAINED"),
        _rate("two effects: both named", clear(records, "two"), 0.80, named),
        _rate("answer within 20 s", list(records), 1.0, lambda r: r["seconds"] <= TIME),
    ]


def names_on_average(records: Sequence[Record]) -> float:
    """Size of the named set where the one hidden effect is in it."""
    sizes = [len(r["answer"]["effects"]) for r in clear(records, "one") if named(r)]
    return sum(sizes) / len(sizes) if sizes else math.nan


def _verdict(*good: str) -> Callable[[Record], bool]:
    return lambda r: r["answer"]["verdict"] in good


def _within(figure: Callable[[Record], float | None], most: float) -> Callable[[Record], bool | None]:
    def judge(record: Record) -> bool | None:
        value = figure(record)
        return None if value is None else value <= most
    return judge


def _rate(name: str, records: Iterable[Record], asked: float, good: Callable[[Record], bool | None]) -> Rate:
    judged = {int(r["seed"]): good(r) for r in records}
    counted = {seed: verdict for seed, verdict in judged.items() if verdict is not None}
    low, high = interval(sum(counted.values()), len(counted))
    bad = tuple(seed for seed, verdict in counted.items() if not verdict)
    return Rate(name, sum(counted.values()), len(counted), asked, low, high, bad)


def interval(good: int, of: int) -> tuple[float, float]:
    """The exact binomial interval of a share (Clopper and Pearson 1934)."""
    tail = (1.0 - CONFIDENCE) / 2
    low = _bisect(lambda p: _at_most(of - good, of, 1.0 - p) < tail) if good > 0 else 0.0
    high = _bisect(lambda p: _at_most(good, of, p) > tail) if good < of else 1.0
    return low, high


def _at_most(k: int, n: int, p: float) -> float:
    """Probability of k or fewer of n."""
    return sum(math.comb(n, i) * p**i * (1.0 - p) ** (n - i) for i in range(k + 1))


def _bisect(below: Callable[[float], bool]) -> float:
    """Where `below` turns false between 0 and 1."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if below(middle) else (low, middle)
    return low


def confusion(records: Iterable[Record]) -> dict[str, Counter[str]]:
    """Truth (its kind; of one effect its name, and whether it is large enough) by verdict and whether it is named."""
    table: dict[str, Counter[str]] = {}
    for r in records:
        table.setdefault(_row(r), Counter())[_column(r)] += 1
    return {row: table[row] for row in sorted(table)}


def _row(record: Record) -> str:
    kind, effects = str(record["truth"]["kind"]), record["truth"]["effects"]
    if kind == "nothing":
        return kind
    size = "" if record in clear([record], kind) else " (small)"
    return f"{kind}{size}" if kind == "two" else f"{kind}: {effects[0]}{size}"


def _column(record: Record) -> str:
    verdict, effects = record["answer"]["verdict"], record["answer"]["effects"]
    if not effects or record["truth"]["kind"] in ("nothing", "outside"):
        return str(verdict)
    return f"{verdict} {'right' if named(record) else 'wrong'}"


def failures(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Every case that counts against one of the rates: which, what is hidden, what was answered."""
    by_seed = {r["seed"]: r for r in records}
    found: dict[int, list[str]] = {}
    for rate in rates(records):
        for seed in rate.bad:
            found.setdefault(seed, []).append(rate.name.strip())
    return [{"seed": seed, "against": against, "signals": by_seed[seed]["truth"]["signals"],
             "hidden": {h["effect"]: h["size"] for h in by_seed[seed]["truth"].get("hidden", [])},
             "floors": visible(by_seed[seed]), "verdict": by_seed[seed]["answer"]["verdict"],
             "named": by_seed[seed]["answer"]["effects"], "error": by_seed[seed]["answer"].get("error")}
            for seed, against in sorted(found.items())]


def summary(records: Sequence[Record]) -> dict[str, Any]:
    """All figures as JSON values: the rates where everything is measured, and their counts by what is measured."""
    by_signals = {s: [r for r in records if r["truth"]["signals"] == s] for s in (JUDGED, "xj,p12", "xj")}
    names = names_on_average(by_signals[JUDGED])
    seconds = sorted(r["seconds"] for r in records)
    return {"cases": len(records),
            "rates": [rate._asdict() | {"share": None if not rate.of else rate.share, "met": rate.met}
                      for rate in rates(by_signals[JUDGED])],
            "by_signals": {s: {rate.name: [rate.good, rate.of] for rate in rates(of)} for s, of in by_signals.items()},
            "names_on_average": None if math.isnan(names) else names,
            "confusion": {row: dict(count) for row, count in confusion(records).items()},
            "seconds": {"median": seconds[len(seconds) // 2], "most": seconds[-1]} if seconds else {},
            "failures": failures(records)}

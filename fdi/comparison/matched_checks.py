"""The checks of several runs, matched by name: what each run measured, and what changed."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdi.trace.trace import Check


@dataclass(frozen=True)
class MatchedCheck:
    """One check in several runs.

    `results` has an entry for each run, None where the run does not have the check. `is_changed`: the runs that have
    checks at all do not agree about the verdict, or only some of them have this check.
    """

    name: str
    results: tuple[Check | None, ...]
    is_changed: bool

    @property
    def first(self) -> Check:
        """The result of the first run that has the check."""
        return next(check for check in self.results if check is not None)

    @property
    def has_other_limits(self) -> bool:
        """Whether the runs that have the check judged it by different limits, or in different units."""
        known = [check for check in self.results if check is not None]
        return any((check.unit, check.kind) != (known[0].unit, known[0].kind)
                   or not np.array_equal([check.low, check.high], [known[0].low, known[0].high], equal_nan=True)
                   for check in known)


def match_checks(checks_of_runs: Sequence[Sequence[Check]]) -> list[MatchedCheck]:
    """The checks of each run, matched by name, in the order in which they first appear.

    Checks of one name in one run are told apart by their order.
    """
    tables = [_number_checks(checks) for checks in checks_of_runs]
    keys = dict.fromkeys(key for table in tables for key in table)
    return [MatchedCheck(key[0], tuple(table.get(key) for table in tables),
                         len({_judge(table.get(key)) for table in tables if table}) > 1) for key in keys]


def _judge(check: Check | None) -> bool | None:
    return None if check is None else check.passed


def _number_checks(checks: Sequence[Check]) -> dict[tuple[str, int], Check]:
    out: dict[tuple[str, int], Check] = {}
    count: dict[str, int] = {}
    for check in checks:
        out[check.name, count.setdefault(check.name, 0)] = check
        count[check.name] += 1
    return out

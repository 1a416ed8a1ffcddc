"""Guards: what trips one, and what none can be."""
from __future__ import annotations

from typing import Any

import pytest

from plant.errors import InputError
from rig.sequences.checks import Guard, GuardWatch


def test_a_guard_trips_after_enough_cycles_in_a_row() -> None:
    guard = Guard(name="far", signal="xj", high=10.0, unit="mm", cycles=3)
    watch = GuardWatch([Guard(name="other", signal="p12", low=-1.0, high=1.0), guard])
    values = [0.011, 0.011, 0.0, 0.011, float("nan"), 0.011, 0.011]
    assert [watch.find_passed({"xj": x}) for x in values] == [None] * 6 + [guard]
    assert GuardWatch([]).find_passed({"xj": 1e9}) is None


@pytest.mark.parametrize("keys", [
    {}, {"low": 1.0, "high": 1.0}, {"high": 1.0, "cycles": 0}, {"high": 1.0, "unit": "bar"},
])
def test_an_impossible_guard_is_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        Guard(name="g", signal="xj", **keys)

"""Shares and their exact intervals, against SciPy's own implementation."""
from __future__ import annotations

import math

import pytest
from scipy.stats import binomtest

from fdi.estimation.binomial import clopper_pearson_interval, measure_share


@pytest.mark.parametrize("confidence", [0.95, 0.99])
@pytest.mark.parametrize(("good", "of"), [(0, 10), (10, 10), (7, 33), (198, 200)])
def test_intervals_are_those_of_clopper_and_pearson(good: int, of: int, confidence: float) -> None:
    exact = binomtest(good, of).proportion_ci(confidence, method="exact")
    assert clopper_pearson_interval(good, of, confidence) == pytest.approx((exact.low, exact.high), abs=1e-9)
    share = measure_share(good, of)
    exact = binomtest(good, of).proportion_ci(0.95, method="exact")
    assert share == pytest.approx((good, of, exact.low, exact.high), abs=1e-9)
    assert share.value == good / of


def test_nothing_counted_says_nothing() -> None:
    share = measure_share(0, 0)
    assert share == (0, 0, 0.0, 1.0) and math.isnan(share.value)

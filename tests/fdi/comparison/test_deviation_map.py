"""Error by speed and amplitude: each residual falls into the cell of its motion."""
from __future__ import annotations

import numpy as np
import pytest

from fdi.comparison.residuals import map_deviation
from fdi.trace.trace import Trace


def make_trace(amplitude: float, frequency: float, rows: int = 4000) -> Trace:
    t = np.arange(rows) / 1000
    xj = amplitude * np.sin(2 * np.pi * frequency * t)
    return Trace.from_columns({"com": xj, "xj": xj, "cor": 0 * t}, 1e-3, {})


def test_the_error_of_a_fast_motion_stands_in_its_cell() -> None:
    slow, fast = make_trace(0.2e-3, 2.0), make_trace(2e-3, 4.0)
    trace = Trace.from_columns({name: np.concatenate([slow.column(name), fast.column(name)])
                                for name in ("com", "xj", "cor")}, 1e-3, {})
    residual = np.where(np.arange(8000) < 4000, 1e-6, 7e-6)
    found = map_deviation(trace, {"xj": residual}, {"xj": 1e-6})
    assert found is not None
    rows = found.amplitudes.searchsorted([0.2e-3, 2e-3]) - 1
    assert np.nanmax(found.ratio["xj"][rows[0], :1]) == pytest.approx(1.0, abs=0.01)
    column = int(found.speeds.searchsorted(45e-3)) - 1
    assert found.ratio["xj"][rows[1], column] == pytest.approx(7.0)
    assert found.rows.sum() > 7900 and found.ratio["xj"].shape == (len(found.amplitudes) - 1, len(found.speeds) - 1)


def test_missing_rows_do_not_count_and_an_empty_map_is_none() -> None:
    trace = make_trace(1e-3, 1.0)
    residual = np.full(4000, np.nan)
    assert map_deviation(trace, {"xj": residual}, {"xj": 1e-6}) is None
    residual[100:140] = 3e-6
    found = map_deviation(trace, {"xj": residual}, {"xj": 1e-6})
    assert found is not None and found.rows.sum() == 40 and np.nanmax(found.ratio["xj"]) == pytest.approx(3.0)

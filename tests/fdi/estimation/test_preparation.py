"""Traces as replays need them: rows of other lengths, gaps, dead sensors, other units; and repeats of a trace."""
from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from noisy_traces import record_healthy

from fdi.estimation.replay import (
    FEWEST_ROWS,
    PERIODS,
    align_columns,
    align_repeat,
    find_repeat,
    hold_inputs,
    match_period,
    read_cycles,
)
from fdi.trace.trace import Trace, bridge_gaps, hold_last, shift_rows
from plant import InputError, Model
from plant.model import find_quantity

MODEL = Model()
NAMES = ("t", "com", "xj", "cor", "p12", "xs", "load")


def columns(**changes: np.ndarray) -> dict[str, np.ndarray]:
    trace = record_healthy()
    return {name: trace.column(name).copy() for name in NAMES} | changes


def made(period: float = 1e-3, **changes: np.ndarray) -> Trace:
    return Trace.from_columns(columns(**changes), period, {})


def test_a_plain_trace_stays_as_it_is() -> None:
    trace = record_healthy()
    (c,) = read_cycles(trace, MODEL)
    assert c.outputs == ("xj", "p12", "xs") and c.notes == () and c.usable.all() and not c.filled.any()
    assert (c.cor == trace.cor).all() and (c.mask_unusable("xs") == trace.xs).all() and len(c) == len(trace)
    (c,) = read_cycles(trace, MODEL, ["xs", "xj"])
    assert c.outputs == ("xj", "xs") and np.isnan(c.p12).all()


@pytest.mark.parametrize(("changes", "field", "words"), [
    ({"xj": 1e3 * record_healthy().xj}, "xj", "values in m; the largest, 5.* is 1.. times jack.travel"),
    ({"com": 1e3 * record_healthy().com}, "com", "values in m"),
    ({"cor": 1e3 * record_healthy().cor}, "cor", "values in A"),
    ({"p12": 1e-5 * record_healthy().p12}, "p12", "values in Pa"),
    ({"p12": 100 * record_healthy().p12}, "p12", "values in Pa"),
    ({"xs": 1e6 * record_healthy().xs}, "xs", "values in m"),
    ({"xs": np.zeros(13_500)}, "xs", r"changes; it is 0 throughout \(--signals xj,p12 leaves it out\)"),
    ({"xj": np.full(13_500, 1e-3)}, "xj", "changes; it is 0.001 throughout$"),
    ({"cor": np.full(13_500, np.nan)}, "cor", "a measured column"),
])
def test_what_cannot_be_is_refused_in_a_line(changes: dict[str, np.ndarray], field: str, words: str) -> None:
    with pytest.raises(InputError, match=f"trace: {field}: expected .*{words}") as told:
        read_cycles(made(**changes), MODEL)
    assert "\n" not in str(told.value)


def test_too_short_and_times_in_ms() -> None:
    short = Trace.from_columns({name: x[:100] for name, x in columns().items()}, 1e-3, {})
    for prepare in (partial(read_cycles, model=MODEL), hold_inputs):
        with pytest.raises(InputError, match=f"at least {FEWEST_ROWS} rows, not 100"):
            prepare(short)
    with pytest.raises(InputError, match="times in s, one row a cycle; the rows are 1 s apart"):
        read_cycles(made(1.0, t=np.arange(13_500.0)), MODEL)
    with pytest.raises(InputError, match="some of xj,p12,xs"):
        read_cycles(record_healthy(), MODEL, ["speed"])
    with pytest.raises(InputError, match="a measured signal; this trace has xj, xs"):
        read_cycles(made(p12=np.full(13_500, np.nan)), MODEL, ["p12"])


def test_rows_at_2_khz_are_taken_once_a_cycle() -> None:
    twice = {name: np.repeat(x, 2) for name, x in columns().items() if name != "t"}
    (c,) = read_cycles(Trace.from_columns(twice | {"t": np.arange(27_000) * 5e-4}, 5e-4, {}), MODEL)
    assert c.period == 1e-3 and (c.cor == record_healthy().cor).all() and "one row a cycle" in c.notes[0]


def test_rows_at_500_hz_can_be_read_in_two_ways() -> None:
    half = Trace.from_columns({name: x[::2] for name, x in columns().items()}, 2e-3, {})
    slow, sparse = read_cycles(half, MODEL)
    assert slow.period == 2e-3 and len(slow) == 6750 and "taken as the trace's, 2 ms" in slow.notes[0]
    assert sparse.period == 1e-3 and len(sparse) == 13_499 and "one cycle in 2" in sparse.notes[0]
    assert sparse.filled.sum() == 6749 and np.isnan(sparse.xs[1::2]).all() and (sparse.cor[::2] == half.cor).all()
    assert not np.isnan(sparse.cor).any() and (sparse.com[1::2] >= sparse.com.min()).all()


def test_single_lost_rows_are_filled_and_long_gaps_are_left_out() -> None:
    cor = record_healthy().cor.copy()
    cor[[100, 5000, 5002]] = np.nan
    cor[9000:9100] = np.nan
    (c,) = read_cycles(made(cor=cor), MODEL)
    assert c.filled.sum() == 103 and c.usable[100] and c.usable[5000]
    assert not c.usable[9000:9399].any() and c.usable[9400] and c.usable[8999]
    assert "missing in 103 of 13500 rows; 0.4 s" in c.notes[-1]
    assert abs(c.cor[5000] - record_healthy().cor[5000]) < 5e-5
    step = record_healthy().cor.copy()
    step[500] = np.nan  # the row in which the demand jumps by 5 mm
    (c,) = read_cycles(made(cor=step), MODEL)
    assert not c.usable[500]


def test_a_sensor_that_hangs_is_left_out_while_it_does() -> None:
    p12 = record_healthy().p12.copy()
    p12[9000:10_000] = p12[9000]
    (c,) = read_cycles(made(p12=p12), MODEL)
    assert not c.usable[9000:10_000].any() and c.usable.sum() == 12_500
    assert "p12 is frozen for 1.00 s, first at 9.00 s" in c.notes[0]
    coarse = np.round(record_healthy().xj / 2e-3) * 2e-3  # a converter of a few bits rests for long, and is alive
    assert read_cycles(made(xj=coarse), MODEL)[0].usable.all()
    dead = record_healthy().xs.copy()
    dead[11_000:] = dead[11_000]
    assert not read_cycles(made(xs=dead), MODEL)[0].usable[11_000:].any()


def test_a_trace_that_starts_in_motion() -> None:
    (c,) = read_cycles(Trace.from_columns({name: x[9700:] for name, x in columns().items()}, 1e-3, {}), MODEL)
    assert not c.usable[:300].any() and c.usable[300] and "already moves" in c.notes[0]


def test_times_that_jitter_are_cycles_still() -> None:
    rng = np.random.default_rng(0)
    (c,) = read_cycles(made(t=columns()["t"] + rng.uniform(-2e-4, 2e-4, 13_500)), MODEL)
    assert len(c) == 13_500 and "off an even grid" in c.notes[0]


def test_cubics_fill_gaps_and_long_gaps_are_held() -> None:
    k = np.arange(60.0)
    curve = 0.01 * (k - 20) ** 3 - k
    x = curve.copy()
    x[[10, 30, 31]] = np.nan
    x[40:50] = np.nan
    x[:2] = np.nan
    filled, marked = bridge_gaps(x, 5)
    assert filled[[10, 30, 31]] == pytest.approx(curve[[10, 30, 31]])
    assert (filled[40:50] == curve[39]).all() and marked[40:50].all() and marked[:2].all() and marked.sum() == 12
    assert hold_last(np.array([np.nan, 1.0, np.nan, 2.0])).tolist() == [0.0, 1.0, 1.0, 2.0]
    assert shift_rows(np.arange(4), 1).tolist() == [0, 0, 1, 2]
    assert shift_rows(np.arange(4), -1).tolist() == [1, 2, 3, 3]


def test_a_repeat_is_found_by_its_command() -> None:
    (c,) = read_cycles(record_healthy(), MODEL)
    assert find_repeat(c, record_healthy(1), MODEL, 1).late == 0
    later = Trace.from_columns({name: x[100:] for name, x in columns().items()}, 1e-3, {})
    repeat = find_repeat(c, later, MODEL, 1)
    assert repeat.late == 100
    rows = align_columns({"xj": repeat.trace.xj}, repeat.late, len(c))["xj"]
    assert np.isnan(rows[:100]).all() and (rows[100:] == c.xj[100:]).all()
    with pytest.raises(InputError, match=r"--repeat .*: com: expected the command of the trace it repeats"):
        other = record_healthy(1)
        find_repeat(c, replace(other, com=-other.com, provenance={"source": "other.csv"}), MODEL, 1)
    with pytest.raises(InputError, match="a signal that the trace has too"):
        find_repeat(read_cycles(record_healthy(), MODEL, ["xs"])[0], made(xs=np.full(13_500, np.nan)), MODEL, 1)
    with pytest.raises(InputError, match="rows as in the trace"):
        find_repeat(c, Trace.from_columns({name: x[::3] for name, x in columns().items()}, 2.5e-3, {}), MODEL, 1)


def test_rows_that_the_check_of_the_firmware_leaves_out() -> None:
    """Rows as recorded: those without Com, XJ or Cor. Rows moved or resampled: those without XJ, or outside the run."""
    cor, com, xj = (columns()[name] for name in ("cor", "com", "xj"))
    cor[5000], com[6000], xj[7000] = np.nan, np.nan, np.nan
    (c,) = read_cycles(made(cor=cor, com=com, xj=xj), MODEL)
    assert np.flatnonzero(c.incomplete).tolist() == [5000, 6000, 7000]

    late = Trace.from_columns({name: x[20:] for name, x in columns(cor=cor, com=com, xj=xj).items()}, 1e-3, {})
    (first,) = read_cycles(record_healthy(), MODEL)
    moved = align_repeat(find_repeat(first, late, MODEL, 1), len(first))
    assert np.flatnonzero(moved.incomplete).tolist() == [*range(20), 7000]

    slow = Trace.from_columns({name: x[::2] for name, x in columns(cor=cor, com=com, xj=xj).items()}, 2e-3, {})
    spread = read_cycles(slow, MODEL)[-1]
    assert len(spread) == 2 * len(slow) - 1 and (spread.incomplete == np.isnan(spread.xj)).all()


def test_a_period_that_no_controller_has_is_refused_in_one_line() -> None:
    quantity = find_quantity("controller.period")
    assert (quantity.low, quantity.high) == PERIODS
    slow = made(50e-3)
    assert match_period(Model(), slow)["controller.period"] == 50e-3
    for period, text in ((5e-5, "0.05 ms"), (0.2, "200 ms")):
        with pytest.raises(InputError, match=rf"0\.1 to 100 ms apart; these rows are {text} apart"):
            match_period(Model(), made(period))

"""Elementary functions and the firmware's law against the library and numbers worked out by hand."""

import math
from collections.abc import Callable
from math import exp, hypot, sin

import numba
import numpy as np
import pytest
from other_cpus import compiles_for

from plant import Controller, Loop, compile_function, compute_current, functions, interpret_function
from plant.compile import _declare_part, _link_calls

RNG = np.random.default_rng(1)
NEAR, TINY = RNG.uniform(-1.0, 1.0, 20000), RNG.normal(size=5000) * 1e-5
ANGLES = np.r_[RNG.uniform(-1e6, 1e6, 20000), RNG.uniform(-7.0, 7.0, 20000), TINY]
# name: arguments, error in units of the last place
CASES = {
    "exp": (np.r_[RNG.uniform(-700.0, 700.0, 20000), NEAR, TINY], 1),
    "log": (np.r_[np.exp(RNG.uniform(-700.0, 700.0, 20000)), 1.5 + NEAR, 1.0 + TINY, 1e-310], 1),
    "sin": (ANGLES, 2),
    "cos": (ANGLES, 2),
    "tan": (ANGLES, 3),
    "tanh": (np.r_[RNG.uniform(-25.0, 25.0, 20000), NEAR, TINY], 2),
    "atan": (np.r_[RNG.uniform(-25.0, 25.0, 20000), NEAR, TINY * 1e10], 1),
}


def many(f: Callable[[float], float]) -> Callable[[np.ndarray, np.ndarray], None]:
    """`f` over an array, compiled as laws are: inlined in a loop."""
    inner = _link_calls(f, {}, _declare_part)

    @numba.njit(error_model="numpy")
    def run(x, y):
        for i in range(len(x)):
            y[i] = inner(x[i])

    return run


@pytest.mark.parametrize("name", CASES)
def test_accuracy_and_the_same_bits_in_plain_python(name: str) -> None:
    x, ulps = CASES[name]
    f, y = getattr(functions, name), np.empty_like(x)
    run = many(f)
    run(x, y)
    truth = np.array([getattr(math, name)(v) for v in x])
    assert (np.abs(y - truth) <= ulps * np.spacing(np.abs(truth))).all()
    assert [f(v) for v in x[::40]] == y[::40].tolist()
    (code,) = run.inspect_asm().values()
    if compiles_for("avx2"):
        assert "%ymm" in code or "%zmm" in code
    else:
        assert "mulpd" in code  # two numbers at a time


def test_functions_of_arrays() -> None:
    """The waves of commands: exact at quarter turns, elsewhere to rounding; and the bits of `exp` for one number."""
    turns = np.r_[RNG.uniform(-3.0, 200.0, 20000), TINY, 0.999999]
    angle = np.array([2 * math.pi * (part - 1.0 if part > 0.5 else part) for part in np.mod(turns, 1.0).tolist()])
    assert np.abs(functions.sin_of_turns(turns) - np.array([math.sin(x) for x in angle])).max() < 4e-16
    assert functions.sin_of_turns(np.arange(-8, 9) / 4.0).tolist() == [0.0, 1.0, 0.0, -1.0] * 4 + [0.0]
    x = np.r_[RNG.uniform(-700.0, 700.0, 2000), NEAR[:500], TINY[:500], 0.0, -745.0, -800.0]
    assert functions.exp_of(x).tolist() == [functions.exp(number) for number in x.tolist()]


@pytest.mark.parametrize(("name", "x", "end_value"), [
    ("exp", math.inf, math.inf), ("exp", -math.inf, 0.0), ("exp", 710.0, math.inf), ("exp", -746.0, 0.0),
    ("exp", 0.0, 1.0), ("exp", -745.0, 5e-324), ("log", 0.0, -math.inf), ("log", -1.0, math.nan),
    ("log", math.inf, math.inf), ("log", 1.0, 0.0), ("sin", 0.0, 0.0), ("sin", math.inf, math.nan),
    ("cos", -math.inf, math.nan), ("cos", 0.0, 1.0), ("tan", 1e300, math.nan), ("tanh", math.inf, 1.0),
    ("tanh", -1e300, -1.0), ("atan", math.inf, math.pi / 2.0), ("atan", -math.inf, -math.pi / 2.0), ("atan", 0.0, 0.0),
    *((name, math.nan, math.nan) for name in CASES)])
def test_at_the_ends(name: str, x: float, end_value: float) -> None:
    with np.errstate(all="raise"):
        y = getattr(functions, name)(x)
    assert y == end_value or (math.isnan(y) and math.isnan(end_value))


def by_name(x: float) -> float:
    return sin(x) + exp(-x) + hypot(x, 3.0)


def by_library(x: float) -> float:
    return math.sin(x) + np.exp(-x) + math.hypot(x, 3.0) + 0.0 * math.pi


def test_they_stand_in_however_a_law_calls_them() -> None:
    """And the library's own stay where they are in code that is not linked."""
    own = functions.sin(1.3) + functions.exp(-1.3) + functions.hypot(1.3, 3.0)
    for f in (by_name, by_library):
        assert compile_function(f)(1.3) == interpret_function(f)(1.3) == own
    assert interpret_function(by_name).__globals__["sin"] is not sin is math.sin
    assert interpret_function(by_library).__globals__["math"].sqrt is math.sqrt


PID = Controller(proportional_gain=4.0, integral_gain=50.0, derivative_gain=0.002, current_limit=8e-3, period=1e-3)
PI, PD = PID._replace(derivative_gain=0.0), PID._replace(integral_gain=0.0)
P = PD._replace(derivative_gain=0.0)


@pytest.mark.parametrize(("law", "rows", "currents"), [
    # 4 A/m on the error, demand minus position; 8 mA at most, either way
    (P, [(1e-3, 0.0), (1e-3, 0.25e-3), (0.0, 0.5e-3), (5e-3, 0.0), (-5e-3, 0.0), (2e-3, 0.0)],
     [4e-3, 3e-3, -2e-3, 8e-3, -8e-3, 8e-3]),
    # errors 1, 0.5, 0.5, 0.75 mm: their rates are none in the first cycle, then -0.5, 0 and +0.25 m/s; times 2 mA
    (PD, [(1e-3, 0.0), (1e-3, 0.5e-3), (1e-3, 0.5e-3), (1e-3, 0.25e-3)], [4e-3, 2e-3 - 1e-3, 2e-3, 3e-3 + 0.5e-3]),
    # 50 A/(m s) for 1 ms: 0.05 A per m of error and cycle, so 0.05 mA a cycle at 1 mm; then -0.1 mA at -2 mm
    (PI, [(1e-3, 0.0), (1e-3, 0.0), (1e-3, 0.0), (0.0, 2e-3)], [4.05e-3, 4.10e-3, 4.15e-3, 0.05e-3 - 8e-3]),
    # errors 1 and 0.5 mm: 4 + 0.05, then 2 + 0.075 - 1 mA
    (PID, [(1e-3, 0.0), (1e-3, 0.5e-3)], [4.05e-3, 1.075e-3]),
    # at 5 mm the output is at its limit and the integral waits; at -1 mm it falls at once, from what it was before
    (PI, [(1e-3, 0.0), *[(5e-3, 0.0)] * 1000, (1e-3, 0.0), (-1e-3, 0.0)],
     [4.05e-3, *[8e-3] * 1000, 4.1e-3, -4e-3 + 0.05e-3]),
], ids=["proportional", "derivative", "integral", "all three", "no wind-up"])
def test_law(law: Controller, rows: list[tuple[float, float]], currents: list[float]) -> None:
    """Currents, A, for rows of demand and position, m."""
    loop, out = Loop(), []
    for demand, position in rows:
        current, loop = compute_current(loop, demand, position, law)
        out.append(current)
    assert out == pytest.approx(currents, abs=1e-15)


def test_the_limit_does_not_stop_an_integral_that_comes_back() -> None:
    """A full integral (7.95 mA) and a falling error: over the limit by the derivative alone, it still unwinds."""
    full = Loop(integral=7.95e-3, error=-2e-3, cycles=1.0)  # the error goes from -2 to -1 mm: +1 m/s, +2 mA
    current, loop = compute_current(full, -1e-3, 0.0, PID._replace(derivative_gain=0.008))  # -4 + 7.9 + 8 mA
    assert current == 8e-3 and loop.integral == pytest.approx(7.9e-3, abs=1e-15)
    again = compute_current(full._replace(error=1e-3), 1e-3, 0.0, PID)[1]  # with the error the other way it waits
    assert again.integral == 7.95e-3

"""Traces for tests of the comparison: the plant in its loop, with noise of any colour and a faulty transducer."""

from collections.abc import Callable
from functools import cache

import numpy as np
from effects_cases import LAWS
from physics_cases import PREFLIGHT

from fdi.trace import Trace
from plant import Actuator, Model
from plant.eha import State
from rig.bench.benchmarks import QUIET

SENSED, PRESSURE, SPOOL = (State._fields.index(name) for name in ("sensed", "pressure", "spool_position"))
LEVELS = np.array([2e-6, 2e4, 1e-6])  # of the nominal transducers: m, Pa, m
TURN = 0.78  # of one sample of coloured noise, what the next one keeps: a corner at 40 Hz, as on the practice bench
HUM = 0.4  # amplitude over the level, 50 Hz
SHORT = np.concatenate([PREFLIGHT[3800:5200], PREFLIGHT[9000:11600]])  # a ramp and a sine: 4 s


def sample_noise(seed: int, rows: int, colour: str = "white") -> np.ndarray:
    """(rows, 3) noise of XJ, P12, XS at the nominal levels; "hum": XJ coloured, with 50 Hz at the same phase always."""
    rng = np.random.default_rng(seed)
    out = rng.standard_normal((rows, 3))
    if colour != "white":
        state, x = 0.0, np.empty(rows)
        for k, draw in enumerate((np.sqrt(1 - TURN**2) * rng.standard_normal(rows)).tolist()):
            state = x[k] = TURN * state + draw
        out[:, 0] = np.sqrt(1 - HUM**2 / 2) * x + HUM * np.sin(2 * np.pi * 0.05 * np.arange(rows) + 0.5)
    return out * LEVELS


def record_plant(changes: dict[str, float] | None = None, com: np.ndarray = PREFLIGHT, seed: int = 0,
                 colour: str = "white", sensor: Callable[[float], float] | None = None, load: float = 0.0) -> Trace:
    """A trace of the nominal plant with some `changes`; `sensor` turns the ram's position into what is sensed."""
    model = Model().replace(QUIET | (changes or {}))
    model = model.with_effects(LAWS) if model.effects else model  # one kernel for all effects
    plant, n = Actuator(model), sample_noise(seed, len(com), colour).tolist()
    state = plant._flat
    gain, limit = model["controller.proportional_gain"], model["controller.current_limit"]
    out, current = np.empty((len(com), 4)), 0.0
    for k, demand in enumerate(com.tolist()):
        xj = state[SENSED] if sensor is None else sensor(float(state[SENSED]))
        xj += n[k][0]
        answer = min(max(gain * (demand - xj), -limit), limit)
        out[k] = xj, answer, state[PRESSURE] + n[k][1], state[SPOOL] + n[k][2]
        plant.advance(current, load)
        current = answer
    xj, cor, p12, xs = out.T
    columns = {"com": com, "xj": xj, "cor": cor, "p12": p12, "xs": xs, "load": np.full(len(com), load)}
    return Trace.from_columns(columns, 1e-3, {"source": f"seed {seed}"})


@cache
def record_healthy(seed: int = 0, colour: str = "white") -> Trace:
    """The nominal plant over the preflight command."""
    return record_plant(seed=seed, colour=colour)


def make_backlash(width: float) -> Callable[[float], float]:
    """A transducer with that play, m, in its coupling."""
    reading = 0.0

    def sense(x: float) -> float:
        nonlocal reading
        reading = min(max(reading, x - width / 2), x + width / 2)
        return reading

    return sense


def make_lag(time: float) -> Callable[[float], float]:
    """A transducer with a first-order lag of `time` s, sampled each ms."""
    reading, keep = 0.0, float(np.exp(-1e-3 / time))

    def sense(x: float) -> float:
        nonlocal reading
        reading = keep * reading + (1 - keep) * x
        return reading

    return sense

"""The plant driven by what was measured: the current or motor speed and, where a rig measures them, the pressures.

The position of a plant whose chamber pressures were measured follows from its flow alone: these pressures are given as
a force, and all that acts on the ram is in them. What the pressures are themselves is predicted without them, from the
drive and the model's forces. So no signal is predicted from itself.
"""
from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fdi.trace.trace import Trace
from plant.lanes import Lanes

Floats = NDArray[np.float64]

SENSOR_MEMORY = 2000  # rows after which a sensor has forgotten what it was shown
# the flow under given pressures; the preload is in the measured ones already
GIVEN = {"pump.pressure_given": 1.0, "undissolved_air.preload": 0.0}


def replay_measured(lanes: Lanes, values: Floats, trace: Trace, current: Floats, position: Floats | None,
                    anchor: float) -> Floats:
    """XJ m, P12 Pa and XS m, (m, n, 3), for each row of `values`, (m, len(lanes.names)).

    Args:
        lanes: runs of a model.
        values: their parameters, SI.
        trace: a prepared recording.
        current: (n,) drive.
        position: (n,) m, to which the ram is pulled; None for a run from the middle.
        anchor: 1/s, how fast.
    """
    out = lanes.replay(values, current, trace.load, position, anchor, trace.parts)
    if not is_driven_by_pressure(trace, lanes):
        return out
    return np.concatenate([_replay_flow(lanes, values, trace, current, position, anchor), out[..., 1:]], axis=-1)


def replay_in_turns(lanes: Lanes, values: Floats, trace: Trace, position: Floats | None, anchor: float,
                    rows: int = 20_000) -> Iterator[tuple[int, Floats]]:
    """The same, as the sensors of the trace show it, so many `rows` at a time: the first row, and (m, k, 3).

    Memory does not grow with the recording, unless the position is predicted from measured pressures.
    """
    if is_driven_by_pressure(trace, lanes):
        whole = trace.pass_sensors(replay_measured(lanes, values, trace, trace.cor, position, anchor))
        yield from ((first, whole[:, first:first + rows]) for first in range(0, len(trace), rows))
        return
    before = np.empty((len(values), 0, 3))  # what a filtering sensor remembers
    for first, out in lanes.replay_in_turns(values, trace.cor, trace.load, position, anchor, rows):
        if not trace.sensors:
            yield first, out
            continue
        known = np.concatenate([before, out], axis=1)
        yield first, trace.pass_sensors(known)[:, before.shape[1]:]
        before = known[:, -SENSOR_MEMORY:]


def is_driven_by_pressure(trace: Trace, lanes: Lanes) -> bool:
    """Whether the position is predicted from measured chamber pressures."""
    return trace.chambers is not None and lanes.model.kind.compute_force is not None


def _replay_flow(lanes: Lanes, values: Floats, trace: Trace, current: Floats, position: Floats | None,
                 anchor: float) -> Floats:
    """XJ, (m, n, 1), with the measured pressures as the force; runs with equal delays of the sensors share one."""
    compute_force, chambers = lanes.model.kind.compute_force, trace.chambers
    assert compute_force is not None and chambers is not None
    given_values = {name: value for name, value in GIVEN.items() if name in lanes.model.values}
    flow = Lanes(lanes.model.replace(given_values), lanes.names, lanes.steps, lanes.workers)
    values = values.copy()
    for i, name in enumerate(lanes.names):
        values[:, i] = GIVEN.get(name, values[:, i])
    shaping = [i for i, name in enumerate(lanes.names) if name in lanes.model.kind.force_parameters]
    kinds, of = np.unique(values[:, shaping], axis=0, return_inverse=True)
    out = np.empty((len(values), len(trace), 1))
    for i, kind in enumerate(kinds):
        rows = of.reshape(-1) == i
        given = dict(lanes.model.values) | dict(zip((lanes.names[j] for j in shaping), kind, strict=True))
        force = compute_force(given, chambers, current, trace.period)
        out[rows] = flow.replay(values[rows], current, force, position, anchor)[..., :1]
    return out

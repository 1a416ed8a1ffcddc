"""Measurements in real time in short blocks: the contenders take turns, so that a disturbance hits all of them."""
from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.progress import Progress
from fdi.report.report import Line
from plant.errors import InputError
from rig.network.raw_bus import can_open
from rig.run.hard_loop import compile_cycle
from rig.run.priority import LOOP_PRIORITY, list_cpus, raise_priority

Seconds = NDArray[np.float64]
Times = Mapping[str, Seconds]  # by quantity, one value a cycle; NaN: no answer came


def measure_blocks(bus: str, seconds: float, blocks: int, contenders: Mapping[str, Callable[[float], Times]],
                   progress: Progress) -> tuple[dict[str, list[Times]], dict[str, Any]]:
    """The times of each contender in each block, `seconds` in all for each of them; and the conditions as JSON values.

    Raises:
        InputError: a bus that compiled code cannot use.
    """
    if not can_open(bus):
        raise InputError("--bus", bus, "socketcan:INTERFACE or udp_multicast[:GROUP]")
    compile_cycle(realtime=True)
    names, found = list(contenders), {name: list[Times]() for name in contenders}
    for block in range(blocks):
        turn = block % len(names)  # nobody is always the first
        for number, name in enumerate(names[turn:] + names[:turn]):
            progress(f"block {block + 1} of {blocks}: {name}", (block + number / len(names)) / blocks)
            found[name].append(contenders[name](seconds / blocks))
    return found, {"bus": bus, "seconds": seconds, "blocks": blocks, "cpus": len(list_cpus()),
                   "priority": choose_priority()}


def choose_priority() -> int:
    """The loop's real-time priority, or 0 where the machine does not grant it."""
    with raise_priority():
        return LOOP_PRIORITY if os.sched_getscheduler(0) == os.SCHED_FIFO else 0


def pool_times(blocks: list[Times]) -> dict[str, Seconds]:
    """The times of all blocks, by quantity."""
    return {quantity: np.concatenate([block[quantity] for block in blocks]) for quantity in blocks[0]}


def compute_percentiles(seconds: Seconds) -> dict[str, float]:
    """p50, p99, p99.9 and the largest of the values that are there, us."""
    known = seconds[~np.isnan(seconds)] * 1e6
    if not len(known):
        return {}
    return dict(zip(("p50", "p99", "p99_9", "max"), np.percentile(known, (50, 99, 99.9, 100)).tolist(), strict=True))


def describe_conditions(figures: Mapping[str, Any]) -> Line:
    """How long was measured, where and with which priority."""
    priority = f"SCHED_FIFO {figures['priority']}" if figures["priority"] else "no real-time priority"
    return Line("measured", f"{figures['seconds']:g} s each in {figures['blocks']} alternating blocks on "
                            f"{figures['bus']}, 1 ms a cycle, {figures['cpus']} CPUs, {priority}")

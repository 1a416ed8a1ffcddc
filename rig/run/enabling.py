"""The controller is made ready in cycles that do not count: CiA 402 is enabled step by step, then its own words say so.

The run stands still meanwhile: neither its profiles nor its faults go on. In real time the last input is repeated until
the next one, which waits for the answer to it.
"""
from __future__ import annotations

from collections.abc import Callable
from math import isclose, nan

import numpy as np

from rig.benches.bench import Bench, Flags
from rig.benches.profiles import PROFILES, State, choose_control, find_state
from rig.network.clock import WallClock
from rig.run.cyclic_values import CycleInput
from rig.run.loop import Loop
from rig.run.watch import PATIENCE, describe_silence
from rig.sequences.protocol import Rows

LIMIT = 5.0  # s: a controller that is not ready by then ends the run


class Enabling:
    """Gets the controller of a bench ready on a loop. `stop()` is True when the run is to end."""

    def __init__(self, bench: Bench, loop: Loop, realtime: bool, stop: Callable[[], bool]) -> None:
        self._bench, self._loop, self._realtime, self._stop = bench, loop, realtime, stop
        self._words = PROFILES[bench.profile]
        self._said: list[tuple[int, float, float]] = []  # control word, status word and current of the cycles
        self._silent = 0  # cycles in a row for which the rig's own plant has had no drive frame

    @property
    def rows(self) -> Rows:
        """What was sent and answered, for the protocol checks; the bench need not have been on time."""
        control, status, current = np.array(self._said, float).reshape(-1, 3).T
        zero = np.zeros(len(control))
        return Rows(zero, zero, current, control, status, zero, zero, on_time=zero > 0)

    def enable(self, demand: float) -> str:
        """Climb to ACTIVE, with fault reset, holding `demand`, m; why that failed, or ""."""
        if not self._words.is_confirmed:
            return ""
        control = 0

        def step() -> CycleInput:
            nonlocal control
            control = choose_control(self._words, State.ACTIVE, self._find_state(), control, resets=True)
            return CycleInput(0, demand, 0.0, control, is_counted=False)

        for _ in range(2):  # the second shows whether the first was answered: a status word from before says nothing
            self._play(step())
        if self._play_until(lambda: self._find_state() == State.ACTIVE, step):
            return ""
        status = int(self._loop.outputs.get("status_word", 0))
        return self._describe_silence() or (
            f"the controller is not enabled after {LIMIT:g} s: status word 0x{status:04X}, "
            f"{State(self._find_state()).name.lower().replace('_', ' ')}")

    def await_ready(self, demand: float, control: int, main_control: int) -> str:
        """Wait, at a `demand` in m, until the controller is ready; why it is not, or "".

        A controller that is not ready at the end of set-up, with `control`, gets the values of main, with
        `main_control`: it may say that it is ready as soon as it is enabled.
        """
        self._play(CycleInput(0, demand, 0.0, control, is_counted=False))
        if self._play_until(self._is_ready, lambda: CycleInput(1, demand, 0.0, main_control, is_counted=False)):
            return ""
        said = ", ".join(f"{name} is {self._loop.outputs.get(name, 0.0):g}, not {value:g}"
                         for name, value in self._bench.ready.items() if not self._has(name, value))
        return self._describe_silence() or f"the controller is not ready after {LIMIT:g} s: {said}"

    def _describe_silence(self) -> str:
        return describe_silence(self._bench, self._silent) if self._silent else ""

    def _play_until(self, is_done: Callable[[], bool], make_step: Callable[[], CycleInput]) -> bool:
        """Play cycles until `is_done()`; False if that takes too long, True also when the run is to end."""
        clock, left = WallClock(), round(LIMIT * 1e9 / self._bench.cycle_ns)
        while not is_done():
            left -= 1
            is_over = clock.now() > LIMIT * 1e9 if self._realtime else self._silent >= PATIENCE
            if left < 0 or is_over:
                return False
            self._play(make_step())
            if self._stop():
                return True
        return True

    def _play(self, step: CycleInput) -> None:
        self._loop.cycle(step)
        self._loop.wait_until_played(self._stop)
        outputs = self._loop.outputs
        current = nan if self._has_flag(Flags.DRIVE_MISSING) else outputs.get(self._bench.signals.drive.word, nan)
        self._said.append((step.control, outputs.get("status_word", 0.0), current))
        is_silent = self._has_flag(Flags.CURRENT_ZEROED) and not self._bench.has_plant_node
        self._silent = self._silent + 1 if is_silent else 0

    def _find_state(self) -> int:
        if self._has_flag(Flags.DRIVE_MISSING):
            return State.UNKNOWN
        return find_state(self._words, int(self._loop.outputs.get("status_word", 0)))

    def _has_flag(self, flag: Flags) -> bool:
        return bool(int(self._loop.outputs.get("flags", 0)) & flag)

    def _is_ready(self) -> bool:
        return all(self._has(name, value) for name, value in self._bench.ready.items())

    def _has(self, name: str, value: float) -> bool:
        return isclose(self._loop.outputs.get(name, 0.0), value, rel_tol=1e-9, abs_tol=1e-12)

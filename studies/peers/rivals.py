"""What both comparisons share: compilers, optional libraries, and rivals measured in alternating rounds."""

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.bench.benchmarks import GET_GCC, find_gcc, measure_durations

Array = NDArray[np.float64]
Replay = Callable[[], Array]
"""A rival's runs; each call makes all of them and returns their results."""

Maker = tuple[str, Callable[[], Replay]]
"""Why a rival cannot be measured here, "" if it can be; and what makes its replay."""


GET_EXTRA = "pip install 'eha-rig[bench]'"


class Rival(NamedTuple):
    """One way to make many runs, and how fast it is."""

    name: str
    speed: float | None  # steps of a run per second; None if it could not be measured
    ratio: float | None  # speed of this software over that of the rival; median over the rounds
    difference: float | None  # m, largest difference of its positions from those of this software
    note: str


class Race(NamedTuple):
    """Rivals measured against one of them, which is this software."""

    rivals: list[Rival]
    reference: Array  # results of this software
    speed: float  # of this software, steps of a run per second


def race_rivals(replays: Mapping[str, Replay], reference: str, steps: int, rounds: int,
                difference: Callable[[Array, Array], float]) -> Race:
    """Measure rivals in alternating rounds.

    Args:
        replays: the rivals by name.
        reference: the name of the one that is this software.
        steps: steps of a run in all runs of one call.
        rounds: how often each is called.
        difference: the difference of a rival's results from those of the reference, m.
    """
    results = {name: replay().copy() for name, replay in replays.items()}
    seconds = measure_durations(replays, rounds)
    rivals = [Rival(name, float(steps / np.median(durations)), float(np.median(durations / seconds[reference])),
                    difference(results[name], results[reference]), "") for name, durations in seconds.items()]
    return Race(rivals, results[reference], steps / float(np.median(seconds[reference])))


def make_replays(makers: Mapping[str, Maker]) -> tuple[dict[str, Replay], list[Rival]]:
    """The rivals that can be measured here, and the others with the reason."""
    replays = {name: make() for name, (reason, make) in makers.items() if not reason}
    return replays, [skip_rival(name, reason) for name, (reason, _) in makers.items() if reason]


def skip_rival(name: str, reason: str) -> Rival:
    """A rival that could not be measured."""
    return Rival(name, None, None, None, f"skipped, {reason}")


def explain_missing_gcc() -> str:
    """Why the rivals in C cannot be measured; "" if gcc is installed."""
    return "" if find_gcc() else f"gcc is not installed; to get it: {GET_GCC}"


def explain_missing(module: str) -> str:
    """Why a rival from the extra `bench` cannot be measured; "" if it is installed."""
    return "" if importlib.util.find_spec(module) else f"{module} is not installed; to get it: {GET_EXTRA}"


def make_progpy_plant(start: Mapping[str, Array], input_names: Sequence[str], output_names: Sequence[str],
                      advance: Callable[[Any, Any], Sequence[Any]]) -> Any:
    """A model of ProgPy, vectorised over the runs, without noise.

    Args:
        start: the states, (m,) each.
        input_names: of the inputs.
        output_names: of the states that are outputs.
        advance: from states and inputs to the next states.
    """
    from progpy import PrognosticsModel

    class Plant(PrognosticsModel):  # type: ignore[misc]
        """The plant without its controller."""

        is_vectorized = True
        inputs, states, outputs = list(input_names), list(start), list(output_names)
        events: list[str] = []  # noqa: RUF012  (the library's own way)

        def initialize(self, u: Any = None, z: Any = None) -> Any:
            return self.StateContainer(dict(start))

        def next_state(self, x: Any, u: Any, dt: float) -> Any:
            return self.StateContainer(dict(zip(start, advance(x, u), strict=True)))

        def output(self, x: Any) -> Any:
            return self.OutputContainer({name: x[name] for name in output_names})

    return Plant(process_noise=0, measurement_noise=0)


def clip(xp: Any, x: Any, limit: Any) -> Any:
    """An array of the library `xp` within +- limit."""
    return xp.maximum(xp.minimum(x, limit), -limit)

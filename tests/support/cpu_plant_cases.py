"""A program: hashes of what the plant computes, one a case, as JSON. Run by test_other_cpus.py."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from physics_cases import PREFLIGHT
from rig_command import job, play

from fdi.trace import open_log
from plant import Actuator, Lanes, Model, Points, build_profile, functions, simulate
from plant.effects import CATALOGUE
from plant.segments import Chirp, Multisine, Ramp, Sine

SHORT = PREFLIGHT[3800:4400]  # a ramp: the ram sticks and slips
SWING = 3e-3 * functions.sin_of_turns(np.arange(600) / 200.0)
LOAD = np.linspace(0.0, 3e3, len(SHORT))
SOME = ("filter_clogging", "stribeck", "current_noise")  # compiled for every CPU, in lanes; single runs: without them
EVERY = tuple(name for name, effect in CATALOGUE.items() if not effect.base and name != "spool_underlap")  # or overlap


def activate_effects(names: tuple[str, ...]) -> Model:
    """The nominal plant with these effects at the sizes that a fit starts from."""
    model = Model()
    for name in names:
        effect = CATALOGUE[name]
        model = model.replace(dict(effect.starts[0]) if effect.starts else {"current_noise.hum": 2e-4})
    return model


def print_hashes() -> None:
    """One object on standard output: case to hash."""
    some, plain = activate_effects(SOME), Model().replace({"filter.clogging": 0.2})
    cases = {
        "commands": build_command(),
        "simulate": np.column_stack(simulate(plain, PREFLIGHT, seed=3)),
        "simulate, load": np.column_stack(simulate(plain, SHORT, LOAD, seed=4)),
        "Actuator": run_actuator(plain, True),
        "interpreted simulate, every effect": np.column_stack(
            simulate(activate_effects(EVERY), SWING[:40], steps=5, fast=False)),
        "interpreted Actuator, effects": run_actuator(some, False),
        "lanes, closed loop": build_lanes(some, 40).closed_loop(sample_values(40), SHORT, LOAD),
        "lanes, replay, effects": build_lanes(some, 20).replay(sample_values(20), 5.0 * SWING, LOAD, SWING, 2.0),
    }
    hashes = {name: hashlib.sha256(np.ascontiguousarray(x).tobytes()) for name, x in cases.items()}
    hashes["log of a run"] = hashlib.sha256(repr(read_log(plain)).encode())
    print(json.dumps({name: digest.hexdigest() for name, digest in hashes.items()}))


def read_log(model: Model) -> list[tuple[int, int, bytes]]:
    """The messages of a short run on the embedded bus but for the times of its cycles, and checks: sums by NumPy."""
    play(replace(job(seed=3), model=model), Path("run"))
    log = open_log(Path("run/trace.mcap"))
    return [each for each in log.list_raw_messages() if log.channels[each[0]].topic not in ("/timing", "/checks")]


def build_command() -> np.ndarray:
    """Every kind of wave."""
    segments = [Sine(amplitude=2e-3, frequency=1.7, time=2.0), Ramp(to=1e-3, time=0.3),
                Chirp(amplitude=1e-3, f0=1.0, f1=31.0, fade=20.0, time=3.0),
                Multisine(amplitude=1e-4, frequencies=tuple(map(float, range(1, 40))), time=3.0),
                Points(points=((0.3, 1e-3), (0.7, -1e-3)))]
    return build_profile(segments).command


def run_actuator(model: Model, fast: bool) -> np.ndarray:
    """Readings and state of a plant that is driven cycle by cycle."""
    plant, rows = Actuator(model, seed=5, steps=10, fast=fast), []
    for k in range(200 if fast else 20):
        rows.append([*plant.sample(), *plant._flat.tolist()])
        plant.advance(float(SWING[k]), float(LOAD[k]))
    return np.array(rows)


def build_lanes(model: Model, runs: int) -> Lanes:
    """`runs` side by side."""
    return Lanes(model, ["filter.clogging", "spool.static_friction", "jack.damping"], steps=10)


def sample_values(runs: int) -> np.ndarray:
    """Their parameters."""
    return np.random.default_rng(6).uniform([0.0, 5.0, 1e3], [0.6, 40.0, 9e3], (runs, 3))


if __name__ == "__main__":
    print_hashes()

"""One case of a campaign: a run is simulated or read, then judged; the answer is one flat row."""
from __future__ import annotations

import platform
import tomllib
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.sources import hash_sources, import_function
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.errors import InputError, RigError
from plant.model import find_effect, parse_model
from plant.solve import NOISES
from rig.network.clock import WallClock
from rig.studies.campaign.matrix import Case
from rig.studies.resumable.row_file import Row
from rig.studies.trial import cases, command, truth
from rig.studies.trial.hidden import CATALOGUE

Array = NDArray[np.float64]
Judgement = Callable[[Trace, Model], Row]
"""A function that judges a run: from the trace and the healthy model to a flat row of JSON values."""

OK, REFUSED, FAILED = "ok", "refused", "failed"


class RandomParts(NamedTuple):
    """The random parts of a simulated case."""

    scatter: dict[str, float]  # parameter "group.field" to the factor on its nominal value
    noise: Array  # (n, NOISES), in units of the sensors' noise


def judge_case(case: Case, spec: Mapping[str, Any], expected_sources: str) -> Row:
    """The row of a case. A refused trace or an exception of the judgement is a row as well.

    Raises:
        RigError: the code of this machine is not that of `expected_sources`, the hash made where the campaign runs.
    """
    if hash_campaign_sources() != expected_sources:
        raise RigError(f"the code on {platform.node()} differs from the code of the campaign: install the same version")
    clock, row, model = WallClock(), describe_case(case, spec), _parse_healthy_model(spec)
    try:
        trace = Trace.read(case.trace) if case.trace else simulate_case(case, spec, model)
        start = clock.now()
        row |= {"status": OK, **load_judgement(spec["work"])(trace, model), "seconds": (clock.now() - start) * 1e-9}
    except RigError as error:
        row |= {"status": REFUSED, "reason": " ".join(str(error).split())}
    except Exception as error:
        row |= {"status": FAILED, "reason": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return row


def describe_case(case: Case, spec: Mapping[str, Any]) -> Row:
    """What is known of a case before it is judged; of a simulated case also the true fault sizes."""
    row = {"case": case.number, "label": case.label, "faults": len(case.sizes), "tolerance": case.tolerance,
           "seed": case.seed, "status": FAILED, "reason": ""}
    if case.trace:
        return row
    model = _parse_healthy_model(spec)
    return row | {"true_kintas": case.sizes.get("filter_clogging", model["filter.clogging"]),
                  "true_fss": case.sizes.get("spool_friction", model["spool.static_friction"])}


def _parse_healthy_model(spec: Mapping[str, Any]) -> Model:
    return parse_model(tomllib.loads(spec["model"]), "campaign")


def simulate_case(case: Case, spec: Mapping[str, Any], model: Model) -> Trace:
    """The preflight check of a plant with the faults, scatter and noise of a case.

    Raises:
        InputError: values that contradict each other, or a fault or change that the chosen simulator does not have.
    """
    com = np.round(command.preflight_command(), 12)
    random_parts = sample_random_parts(case, len(com), spec["colour"], spec["hum"])
    provenance = {"source": case.label, "seed": str(case.seed)}
    if spec["simulator"] == "independent":
        columns = _simulate_independently(case, model, com, random_parts)
    else:
        unit = model.replace({name: factor * model[name] for name, factor in random_parts.scatter.items()})
        columns = simulate(add_faults(unit, case.sizes), com, drawn=random_parts.noise)._asdict()
    measured = {"com", "cor", "load", *spec["signals"].split(",")}
    return Trace.from_columns({name: columns[name] for name in columns if name in measured}, model["controller.period"],
                    provenance)


def sample_random_parts(case: Case, cycles: int, colour: float, hum: float) -> RandomParts:
    """Scatter and noise, drawn as in the blind trial.

    Another label gives other random numbers. Another tolerance gives the same, so that a unit is comparable with
    itself at another tolerance.
    """
    rng = np.random.default_rng([case.seed, 11, zlib.crc32(case.label.encode())])
    nominal = truth.nominal_symbols()
    symbols = cases.sample_healthy_plant(case.tolerance, rng)
    position = cases.sample_position_noise(cycles, cases.BenchLevel(case.tolerance, colour, hum), rng)
    noise = np.column_stack([position / cases.FLOORS["xj"], rng.standard_normal((cycles, NOISES - 1))])
    return RandomParts({truth.SYMBOLS[symbol]: value / nominal[symbol] for symbol, value in symbols.items()}, noise)


def add_faults(model: Model, sizes: Mapping[str, float]) -> Model:
    """The model with effects of these sizes: values of each effect's first parameter.

    The effect's further parameters follow: of a parameter of the base model in proportion to the first one (dynamic
    friction to static friction), of an added effect as in the start whose first parameter is nearest to the size.
    """
    for name, size in sizes.items():
        effect = find_effect(name, model.plant)
        first, *others = effect.fitted
        if effect.base:
            changes = {other: model[other] * size / model[first] for other in others}
        else:
            starts = sorted(effect.starts, key=lambda start: abs(start[first] - size))
            changes = {other: starts[0][other] for other in others if starts}
        model = model.replace(changes | {first: size}, name)
    return model


def _simulate_independently(case: Case, model: Model, com: Array, random_parts: RandomParts) -> dict[str, Array]:
    """The same plant by the blind trial's simulator, which shares no physics with `plant`."""
    symbol_of = {name: symbol for symbol, name in truth.SYMBOLS.items()}
    for name in model.list_changes().keys() - symbol_of.keys():
        raise InputError("--simulator", name, "a parameter of the independent simulator")
    symbols = {symbol_of[name]: value for name, value in model.list_changes().items()}
    symbols |= {symbol_of[name]: factor * model[name] for name, factor in random_parts.scatter.items()}
    for name, size in case.sizes.items():
        law = CATALOGUE[name]
        changes = law.apply(size, truth.nominal_symbols() | symbols)
        if changes.get(law.shown) != size or law.extra or law.choices:
            raise InputError("--simulator", name, "an effect with a single size, which the independent simulator has")
        symbols |= changes
    noise = random_parts.noise
    run = truth.simulate_truth(com, symbols, cases.FLOORS["xj"] * noise[:, 0])
    return run._asdict() | {"p12": run.p12 + cases.FLOORS["p12"] * noise[:, 1],
                            "xs": run.xs + cases.FLOORS["xs"] * noise[:, 2]}


def load_judgement(name: str) -> Judgement:
    """The judgement "module:function".

    Raises:
        InputError: there is no such function.
    """
    return import_function(name, "--work", "a judgement")


def hash_campaign_sources() -> str:
    """A hash of all code and data that a row depends on."""
    campaign = (f"rig/studies/campaign/{name}.py" for name in ("campaign_case", "judge", "matrix"))
    return hash_sources("plant", "fdi", *campaign, "rig/studies/trial")

"""One case of a campaign: the run, simulated or read, and what the judgement makes of it, as one flat row."""
from __future__ import annotations

import platform
import tomllib
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.sources import digest, named
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.errors import InputError, RigError
from plant.model import entry, parse_model
from plant.solve import NOISES
from rig.network.clock import WallClock
from rig.studies.campaign.matrix import Case
from rig.studies.trial import cases, command, truth
from rig.studies.trial.hidden import CATALOGUE

Array = NDArray[np.float64]
Row = dict[str, Any]
Work = Callable[[Trace, Model], Row]
"""What judges a run: trace and healthy model to a flat row of JSON values."""

OK, REFUSED, FAILED = "ok", "refused", "failed"
MAKERS = ("rig/studies/campaign/case.py", "rig/studies/campaign/judge.py", "rig/studies/campaign/matrix.py",
          "rig/studies/trial")


class Drawn(NamedTuple):
    """What chance decides in a case."""

    scatter: dict[str, float]  # "group.field" to factor
    noise: Array  # (n, NOISES), in units of the sensors' noise


def one(case: Case, spec: Mapping[str, Any], code: str) -> Row:
    """The row of a case. Whatever goes wrong in it is its answer.

    Raises:
        RigError: the code here is not `code`, what `sources` gave where the case was ordered.
    """
    if sources() != code:
        raise RigError(f"the code of {platform.node()} is not that of the campaign: install the same there")
    clock, row, model = WallClock(), told(case, spec), _model(spec)
    try:
        trace = Trace.read(case.trace) if case.trace else run(case, spec, model)
        begun = clock.now()
        row |= {"status": OK, **find_work(spec["work"])(trace, model), "seconds": (clock.now() - begun) * 1e-9}
    except RigError as error:
        row |= {"status": REFUSED, "reason": " ".join(str(error).split())}
    except Exception as error:
        row |= {"status": FAILED, "reason": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return row


def told(case: Case, spec: Mapping[str, Any]) -> Row:
    """What is known of a case before it is judged: of a simulated one the truth, too."""
    row = {"case": case.number, "label": case.label, "faults": len(case.sizes), "tolerance": case.tolerance,
           "seed": case.seed, "status": FAILED, "reason": ""}
    if case.trace:
        return row
    model = _model(spec)
    return row | {"true_kintas": case.sizes.get("filter_clogging", model["filter.clogging"]),
                  "true_fss": case.sizes.get("spool_friction", model["spool.static_friction"])}


def _model(spec: Mapping[str, Any]) -> Model:
    return parse_model(tomllib.loads(spec["model"]), "campaign")


def run(case: Case, spec: Mapping[str, Any], model: Model) -> Trace:
    """The preflight check of a plant with the faults, scatter and noise of a case.

    Raises:
        InputError: values that contradict each other; a fault or change that the chosen simulator does not have.
    """
    com = np.round(command.preflight(), 12)
    chance = draw(case, len(com), spec["colour"], spec["hum"])
    there = {"source": case.label, "seed": str(case.seed)}
    if spec["simulator"] == "independent":
        columns = _independent(case, model, com, chance)
    else:
        healthy = model.replace({name: factor * model[name] for name, factor in chance.scatter.items()})
        columns = simulate(faulty(healthy, case.sizes), com, drawn=chance.noise)._asdict()
    measured = {"com", "cor", "load", *spec["signals"].split(",")}
    return Trace.of({name: columns[name] for name in columns if name in measured}, model["controller.period"], there)


def draw(case: Case, cycles: int, colour: float, hum: float) -> Drawn:
    """Scatter and noise as the blind trial draws them; other labels get other numbers, other tolerances the same."""
    rng = np.random.default_rng([case.seed, 11, zlib.crc32(case.label.encode())])
    usual = truth.nominal_symbols()
    symbols = cases.scattered(case.tolerance, rng)
    position = cases.coloured(cycles, cases.Level(case.tolerance, colour, hum), rng) / cases.FLOORS["xj"]
    noise = np.column_stack([position, rng.standard_normal((cycles, NOISES - 1))])
    return Drawn({truth.SYMBOLS[s]: x / usual[s] for s, x in symbols.items()}, noise)


def faulty(model: Model, sizes: Mapping[str, float]) -> Model:
    """The model with effects of these sizes: values of their first parameters.

    What belongs to a size goes with it: dynamic friction in proportion to static; of an effect that the reference
    model lacks, the further parameters of the start whose first one is nearest.
    """
    for name, size in sizes.items():
        effect = entry(name, model.plant)
        first, *others = effect.fitted
        if effect.base:
            changes = {other: model[other] * size / model[first] for other in others}
        else:
            starts = sorted(effect.starts, key=lambda start: abs(start[first] - size))
            changes = {other: starts[0][other] for other in others if starts}
        model = model.replace(changes | {first: size}, name)
    return model


def _independent(case: Case, model: Model, com: Array, chance: Drawn) -> dict[str, Array]:
    """The same by the blind trial's simulator, which shares no physics with `plant`."""
    known = {name: symbol for symbol, name in truth.SYMBOLS.items()}
    for name in model.differences().keys() - known.keys():
        raise InputError("--simulator", name, "a parameter of the independent simulator")
    symbols = {known[name]: value for name, value in model.differences().items()}
    symbols |= {known[name]: factor * model[name] for name, factor in chance.scatter.items()}
    for name, size in case.sizes.items():
        law = CATALOGUE[name]
        changes = law.apply(size, truth.nominal_symbols() | symbols)
        if changes.get(law.shown) != size or law.extra or law.choices:
            raise InputError("--simulator", name, "an effect of one size, which the independent simulator has")
        symbols |= changes
    made = truth.simulate(com, symbols, cases.FLOORS["xj"] * chance.noise[:, 0])
    return made._asdict() | {"p12": made.p12 + cases.FLOORS["p12"] * chance.noise[:, 1],
                             "xs": made.xs + cases.FLOORS["xs"] * chance.noise[:, 2]}


def find_work(name: str) -> Work:
    """The judgement "module:function".

    Raises:
        InputError: there is no such thing.
    """
    return named(name, "--work", "a judgement")


def sources() -> str:
    """A hash of all code and data that a row depends on."""
    return digest("plant", "fdi", *MAKERS)

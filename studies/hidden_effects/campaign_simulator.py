"""A simulator for `rig campaign --simulator studies.hidden_effects.campaign_simulator:simulate_unit`: truth.c."""

import numpy as np
from numpy.typing import NDArray

from plant import InputError
from rig.campaign.judge import FLOORS, Unit
from studies.hidden_effects.hidden import CATALOGUE
from studies.hidden_effects.truth import SYMBOLS, nominal_symbols, simulate_truth


def simulate_unit(unit: Unit) -> dict[str, NDArray[np.float64]]:
    """The columns of a unit by the simulator in C, which shares no physics with `plant`.

    Raises:
        InputError: a parameter, or an effect with several sizes, which this simulator does not have.
    """
    symbol_of = {name: symbol for symbol, name in SYMBOLS.items()}
    for name in unit.model.list_changes().keys() - symbol_of.keys():
        raise InputError("--simulator", name, "a parameter of the independent simulator")
    symbols = {symbol_of[name]: value for name, value in unit.model.list_changes().items()}
    symbols |= {symbol_of[name]: factor * unit.model[name] for name, factor in unit.scatter.items()}
    for name, size in unit.sizes.items():
        law = CATALOGUE[name]
        changes = law.apply(size, nominal_symbols() | symbols)
        if changes.get(law.shown) != size or law.extra or law.choices:
            raise InputError("--simulator", name, "an effect with a single size, which the independent simulator has")
        symbols |= changes
    run = simulate_truth(unit.command, symbols, FLOORS["xj"] * unit.noise[:, 0])
    return run._asdict() | {"p12": run.p12 + FLOORS["p12"] * unit.noise[:, 1],
                            "xs": run.xs + FLOORS["xs"] * unit.noise[:, 2]}

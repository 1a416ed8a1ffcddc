"""The physics of the electrohydraulic actuator: no I/O, no clock, no CAN."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from plant.blas import fix_blas_kernels
from plant.errors import InputError, RigError

fix_blas_kernels()  # before anything imports NumPy

if TYPE_CHECKING:
    from plant.model import Model, load_model
    from plant.run import Actuator, Columns, simulate

__all__ = ["Actuator", "Columns", "InputError", "Model", "RigError", "load_model", "simulate"]

# Imported at first use: the plant loads numba, which takes longer than `rig --help` may.
_MODULE_OF = {"Actuator": "plant.run", "Columns": "plant.run", "Model": "plant.model", "load_model": "plant.model",
              "simulate": "plant.run"}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value

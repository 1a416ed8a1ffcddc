"""The physics of the electrohydraulic actuator: no I/O, no clock, no CAN."""
from plant.errors import InputError, RigError
from plant.model import Model, load_model
from plant.run import Actuator, Columns, simulate

__all__ = ["Actuator", "Columns", "InputError", "Model", "RigError", "load_model", "simulate"]

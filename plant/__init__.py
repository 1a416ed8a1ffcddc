"""The physics of actuators: no I/O, no clock, no CAN. The stub file beside this one lists the names."""

from lazy_loader import attach_stub

from plant.blas import fix_blas_kernels

fix_blas_kernels()  # before anything imports NumPy

__getattr__, __dir__, _ = attach_stub(__name__, __file__)
# What users of the Python interface need (docs/python.md); the other names are for fdi and rig.
__all__ = ["Actuator", "Columns", "InputError", "Model", "RigError", "load_model", "simulate"]

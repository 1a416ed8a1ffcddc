"""The nodes of the bench: plant emulator and reference firmware, and the scenario that the emulator is given."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)

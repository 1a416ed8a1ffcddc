"""Buses, links, wire, clock and the CANopen master."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)

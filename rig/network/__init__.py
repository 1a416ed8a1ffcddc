"""Buses, links, wire, clock and the CANopen master."""

"""Buses, links, wire, clock, codec and the CANopen master."""

"""Conformance test of a CANopen node against CiA 301 and its own EDS, over the bus alone.

The package imports nothing of the project's own CANopen core: a test must not share an error with what it tests.
"""

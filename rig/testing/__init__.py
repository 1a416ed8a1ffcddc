"""Tests of a controller in Python: a bench that runs sequences and commands, and its pytest fixture."""

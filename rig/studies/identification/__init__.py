"""Trials of `rig identify` on actuators of another size, simulated in C."""

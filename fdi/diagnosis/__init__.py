"""How healthy the servovalve is: bands, precursors, grid and refined sizes of two faults, from one captured test."""

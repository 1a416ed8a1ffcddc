"""How healthy the servovalve is: bands, precursors, grid and refined size of two faults, from one captured preflight."""

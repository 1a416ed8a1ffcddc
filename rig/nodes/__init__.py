"""The nodes of the bench: plant emulator and reference firmware, and the scenario that the emulator is given."""

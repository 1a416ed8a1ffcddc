"""The bench: buses, nodes, master, loop, sequences, log, viewer and the `rig` command."""

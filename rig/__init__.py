"""The bench: buses, nodes, master, loop, sequences, log, viewer and the `rig` command."""
import plant  # noqa: F401  selects the kernels of linear algebra before anything imports NumPy

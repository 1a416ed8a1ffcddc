"""The bench: buses, nodes, master, loop, sequences, log, viewer and the `rig` command."""
import plant  # noqa: F401  selects the kernels of linear algebra before anything imports NumPy
from plant import READERS

READERS.update(dict.fromkeys((".fmu", ".toml"), "rig.fmi.plant_file:load_fmu_plant"))

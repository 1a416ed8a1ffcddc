"""The bench: buses, nodes, master, loop, sequences, log, viewer and the `rig` command."""

import os

# Fits run one lane kernel a thread and do little algebra between; BLAS threads of their own spin against these, and on
# a busy machine a fit then takes three to ten times as long. To be said before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

"""What the physics tests share: the preflight command, and plants without noise or friction."""

from plant import Model
from rig.bench.benchmarks import FRICTIONLESS, QUIET
from rig.sequences import load_sequence

PREFLIGHT = load_sequence("preflight").build_main_profile().command
SILENT = Model().replace(QUIET)
SMOOTH = SILENT.replace(FRICTIONLESS)  # no dry friction

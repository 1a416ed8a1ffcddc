"""The `rig` command: one file per subcommand, its options and the terminal."""

from lazy_loader import attach_stub

__getattr__, __dir__, _ = attach_stub(__name__, __file__)

"""The `rig` command: one file per subcommand, its options and the terminal."""
from rig.cli.main import main

__all__ = ["main"]

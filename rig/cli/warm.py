"""Compiles what `rig explain` and `rig add` need ahead of their first use: `python -m rig.cli.main.warm`."""
from __future__ import annotations

from plant import Model
from plant.lanes import warm
from plant.model import offered
from rig.cli.progress_bar import waiting


def main() -> None:
    """The kernels of the reference plant with the whole catalogue, into the user's cache."""
    with waiting(silent=False) as update:
        warm(Model().having(effect.name for effect in offered()), update)


if __name__ == "__main__":
    main()

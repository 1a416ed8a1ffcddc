"""Compiles what `rig explain` and `rig add` need ahead of their first use: `python -m rig.cli.warm`."""
from __future__ import annotations

from plant import Model
from plant.lanes import compile_kernels
from plant.model import list_searched_effects
from rig.cli.progress_bar import show_progress


def main() -> None:
    """Compile the kernels of the reference plant with the whole catalogue into the user's cache."""
    with show_progress(is_silent=False) as progress:
        compile_kernels(Model().with_effects(effect.name for effect in list_searched_effects()), progress)


if __name__ == "__main__":
    main()

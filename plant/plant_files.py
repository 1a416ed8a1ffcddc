"""Files that describe plants and are read elsewhere: `READERS` has their suffix, and "module:function" that reads them.

A package that reads such files adds its function, which makes a `plant.plants.Plant` of a path.
"""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from plant.parameters import read_toml

READERS: dict[str, str] = {}


def read_model_tables(path: Path) -> dict[str, Any]:
    """The tables of a model file; of a file that describes a plant, that it is nominal.

    Raises:
        InputError: unreadable, or not TOML.
    """
    return {"plant": path.name} if path.suffix in READERS and path.suffix != ".toml" else read_toml(path)


def read_named_plant(plant_entry: Any, where: object) -> Any:
    """What models call the plant that the file `where` names: a file beside it, or a table of its own.

    Any other name stays as it is.

    Raises:
        InputError: the file cannot be used.
    """
    path = Path(str(where))
    if isinstance(plant_entry, str):
        path = path.parent / plant_entry if (path.parent / plant_entry).is_file() else Path(plant_entry)
    elif not isinstance(plant_entry, Mapping):
        return plant_entry
    if path.suffix not in READERS:
        return plant_entry
    module, _, function = READERS[path.suffix].partition(":")
    return getattr(import_module(module), function)(path).key

"""Code by name and by content: functions named by the user, and hashes of the code that a result depends on."""

import hashlib
import importlib
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from plant import InputError, require

SUFFIXES = (".py", ".toml", ".c", ".json", ".npz")  # what a number can depend on; no pages, no caches


def name_software() -> str:
    """Name and version of this software."""
    return f"eha-rig {version('eha-rig')}"


def import_function(name: str, field: str, expected: str) -> Callable[..., Any]:
    """The function "module:function".

    Raises:
        InputError: there is no such function; the message names `field` and what was `expected`.
    """
    module, _, attribute = name.partition(":")
    try:
        function = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise InputError(field, name, f"module:function of {expected} ({error})") from None
    require(callable(function), field, name, f"module:function of {expected}")
    return function  # type: ignore[no-any-return]


@cache
def hash_sources(*places: str) -> str:
    """A hash, 16 hexadecimal digits, of all code and data in packages and files: "plant", "studies/hidden_effects"."""
    digest = hashlib.sha256()
    for place in places:
        package, *rest = place.split("/")
        path = Path(str(files(package).joinpath(*rest)))
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.suffix in SUFFIXES:
                digest.update(f"{place}/{file.relative_to(path).as_posix()}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]

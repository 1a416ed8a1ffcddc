"""Code that a log or a model file brings along. It runs only if the user trusts it, and it is announced before.

A recording, a model file and a folder of results are data that people send to each other. What they contain must not
run on the machine of the person who opens them. A file on the command line is the user's own choice.
"""

import hashlib
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from plant import InputError, escape_control_characters, load_plant, read_file, read_model_tables, read_toml, require
from plant.effects import CATALOGUE, load_effects

Announce = Callable[[str], None]


class ForeignCode(NamedTuple):
    """A Python file that a log or a model file brings along."""

    name: str  # as the log or the model file has it, or where the file was found
    content: bytes

    @property
    def sha256(self) -> str:
        """SHA-256 of the content, hexadecimal."""
        return hashlib.sha256(self.content).hexdigest()


def print_on_standard_error(text: str) -> None:
    """Print a line on standard error: standard output may be one JSON object."""
    print(text, file=sys.stderr, flush=True)


def require_trust(origin: object, codes: Sequence[ForeignCode], *, is_trusted: bool,
                  announce: Announce = print_on_standard_error) -> None:
    """Announce the code of `origin` that is about to run: name, origin, size, SHA-256.

    Raises:
        InputError: the user has not said that it may run. Nothing has run then.
    """
    if codes and not is_trusted:
        listing = ", ".join(f"{code.name} (SHA-256 {code.sha256})" for code in codes)
        raise InputError(origin, "", f"--trust, because it brings code along that would run here: {listing}")
    for code in codes:
        announce(escape_control_characters(
            f"trusted code: {code.name}, {len(code.content)} bytes, from {origin}, SHA-256 {code.sha256}"))


def load_effects_of_model(model: str | Path | None, user_files: Sequence[Path] = (), *, is_trusted: bool,
                          announce: Announce = print_on_standard_error) -> tuple[Path, ...]:
    """Run the effect files that a model file names, if the user trusts them.

    They are looked for in this folder and beside the model file; what is not found is skipped. A file that has been
    loaded already does not run again.

    Args:
        model: a model file; None or the name of a shipped model has no such files.
        user_files: effect files that the user has named himself; each replaces one of the same name.
        is_trusted: whether the user lets this code run.
        announce: gets a line about each file before it runs.

    Returns:
        The files that have run.

    Raises:
        InputError: there are such files and the user does not trust them, or one of them cannot be used.
    """
    loaded_files = {effect.file for effect in CATALOGUE.list_all().values()}  # as each file is now or was before
    paths = [path for path in find_effect_files(model, user_files) if path.absolute() not in loaded_files]
    codes = [ForeignCode(str(path), read_file(path)) for path in paths]
    require_trust(model, codes, is_trusted=is_trusted, announce=announce)
    for path, code in zip(paths, codes, strict=True):
        load_effects(path, code.content)
    return tuple(paths)


def load_plant_of_model(model: str | Path | None, *, is_trusted: bool,
                        announce: Announce = print_on_standard_error) -> None:
    """Run the plant file that is the model, or that a model file names if the user trusts it; neither: do nothing.

    The file of a model file is looked for beside it and in this folder.

    Raises:
        InputError: a plant file that is not trusted, not there, or no plant.
    """
    path = Path(model or "")
    if path.suffix == ".py":
        load_plant(path)
    elif path.suffix == ".toml" and path.is_file():
        name: Any = read_toml(path).get("plant")
        if not isinstance(name, str) or not name.endswith(".py"):
            return
        places = [place for place in (path.parent / name, Path(name)) if place.is_file()]
        require(places, path, "plant", f"a file that exists, not {name!r}")
        code = ForeignCode(str(places[0]), read_file(places[0]))
        require_trust(path, [code], is_trusted=is_trusted, announce=announce)
        load_plant(places[0], code.content)


def find_effect_files(model: str | Path | None, user_files: Sequence[Path] = ()) -> list[Path]:
    """The effect files that a model file names and that exist, without those of the same name as one in `user_files`.

    Raises:
        InputError: the model file cannot be read.
    """
    if model is None or Path(model).suffix == ".py" or not Path(model).is_file():
        return []
    provenance: Any = read_model_tables(Path(model)).get("provenance", {})
    names = provenance.get("effect_files", []) if isinstance(provenance, Mapping) else []
    files = [Path(name) for name in names if isinstance(name, str) and "\0" not in name]
    places = [next((p for p in (file, Path(model).parent / file) if p.is_file()), None) for file in files]
    replaced_names = {file.name for file in user_files}
    return list(dict.fromkeys(path for path in places if path is not None and path.name not in replaced_names))


def require_different_names(files: Sequence[Path]) -> None:
    """Refuse two effect files of one name: a log stores them by name.

    Raises:
        InputError: the second file of that name.
    """
    for i, file in enumerate(files):
        require(file.name not in [other.name for other in files[:i]], "--effects", str(file),
                f"files of different names, not a second {file.name}")

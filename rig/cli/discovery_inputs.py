"""What `rig compare`, `rig explain`, `rig add`, `rig remove` and `rig identify` take: a model with its past, runs."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from fdi.discovery.update_model import Provenance, load_model_file
from plant import Model, find_effect, find_plant, load_model, require
from rig.cli.answer import choose_file
from rig.cli.inputs import change_model, load_chosen_effects


def load_known_model(args: argparse.Namespace) -> tuple[Model, Provenance]:
    """The model of --model, --set and --effects, with its provenance, which names all effect files in use.

    Raises:
        InputError: a file or a value that cannot be used, or a model file with code that --trust does not allow.
    """
    load_chosen_effects(args)
    is_file = args.model and Path(args.model).suffix != ".py" and Path(args.model).is_file()
    model, provenance = (load_model_file(Path(args.model)) if is_file else
                         (load_model(args.model or "eha"), Provenance()))
    files = tuple(dict.fromkeys([*provenance.effect_files, *map(str, args.effects)]))
    return change_model(model, args), replace(provenance, effect_files=files)


def split_words(words: Sequence[str], plant: str, trace: str | None = None) -> tuple[list[str], str | None]:
    """The effects of a plant among the words of a command, and the trace: one of them if `trace` is None.

    Raises:
        InputError: a word that is neither an effect nor a trace; it offers the nearest effect.
    """
    effects, names = [], [e.name for e in find_plant(plant).list_effects()]
    for word in words:
        is_file = word.endswith((".csv", ".csv.gz", ".mcap")) or Path(word).exists()
        if trace is None and is_file and word not in names:
            trace = word
        else:
            effects.append(find_effect(word, plant).name)
    require(effects, "effect", "", "at least one effect (rig effects lists them)")
    return effects, trace


def choose_model_file(args: argparse.Namespace, trace: str | None) -> Path:
    """The model file to write: --out, else the file of --model, else model.toml.

    Raises:
        InputError: a place that cannot be written, or another kind of file.
    """
    model_file = Path(args.model or "")
    default = args.model if model_file.suffix == ".toml" and model_file.is_file() else "model.toml"
    path = choose_file(args.out or default, (".toml",), trace)
    assert path is not None
    return path


def format_command_line() -> str:
    """The command as the user typed it, for the history of a model file; "rig" in another program."""
    is_command = Path(sys.argv[0]).name in ("rig", "main.py")  # main.py: python -m rig.cli.main
    return shlex.join(["rig", *sys.argv[1:]]) if is_command else "rig"

"""What the options of several commands stand for: the plant model, the effects of the user, the signals to use."""

import argparse
import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from fdi import foreign_code
from fdi.trace import locate_log, open_log
from plant import InputError, Model, load_model, read_toml, require
from plant.effects import load_effects
from rig.run import find_visible_steps


def parse_changes(pairs: Sequence[str]) -> dict[str, str]:
    """Parse the --set options: "GROUP.FIELD" to value.

    Raises:
        InputError: an option that is not GROUP.FIELD=VALUE.
    """
    table: dict[str, str] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        require(equals and value and "." in name, "--set", pair, "GROUP.FIELD=VALUE, such as spool.static_friction=35")
        table[name.strip()] = value.strip()
    return table


def load_user_effects(files: Sequence[Path]) -> None:
    """Add the effects of files that the user names to the catalogue.

    Raises:
        InputError: an invalid file, or two files of one name.
    """
    foreign_code.require_different_names(files)
    for file in files:
        load_effects(file)


def load_chosen_effects(args: argparse.Namespace) -> None:
    """Add the user's own effects to the catalogue: the files of --effects and, with --trust, those of a model file.

    Raises:
        InputError: an invalid file, code that --trust does not allow, or two files of one name.
    """
    args.model = args.model or find_recorded_plant(args)
    foreign_code.load_plant_of_model(args.model, is_trusted=args.trust)
    load_user_effects(args.effects)
    brought = foreign_code.load_effects_of_model(args.model, args.effects, is_trusted=args.trust)
    foreign_code.require_different_names((*args.effects, *brought))


def find_log(args: argparse.Namespace) -> Path | None:
    """The first log among the arguments."""
    arguments = [getattr(args, "trace", None), *(getattr(args, name, None) or [] for name in ("runs", "words"))]
    names = [name for each in arguments if each for name in ([each] if isinstance(each, str | Path) else each)]
    return next((path for path in map(Path, names) if path.suffix == ".mcap" or (path / "trace.mcap").is_file()), None)


def find_recorded_plant(args: argparse.Namespace) -> str | None:
    """The plant that the first log among the arguments was recorded on; None for `eha`, and where there is no log.

    Raises:
        InputError: the log brings a plant along that --trust does not allow.
    """
    log = find_log(args)
    if log is None:
        return None
    from rig.run import load_plant_of_log  # here: commands without a log need none of it

    return load_plant_of_log(log, is_trusted=args.trust) or None


def change_model(model: Model, args: argparse.Namespace) -> Model:
    """The model with the changes of --set, and with the steps in which the frames of a logged run carry the position.

    --set gets these steps for the commands to type next.

    Raises:
        InputError: a change that is not possible.
    """
    log = find_log(args)
    if log is not None:
        with suppress(InputError, KeyError, ValueError):  # of an older log it is not known
            step = float(open_log(locate_log(log)).metadata["run"]["resolution"])
            args.set = [*(f"{name}={value:g}" for name, value in find_visible_steps(model, step).items()), *args.set]
    return model.replace(parse_changes(args.set))


def load_chosen_model(args: argparse.Namespace) -> Model:
    """Load the model that --model, --set and --effects describe.

    Raises:
        InputError: a file, name or value that is invalid, or a model file with code that --trust does not allow.
    """
    load_chosen_effects(args)
    return change_model(load_model(args.model or "eha"), args)


def load_declared_model(args: argparse.Namespace) -> Model:
    """The model of --model, or the EHA: its plant declares the signals that a recording has.

    Raises:
        InputError: an invalid model, or code of it that --trust does not allow.
    """
    foreign_code.load_plant_of_model(args.model, is_trusted=args.trust)
    foreign_code.load_effects_of_model(args.model, is_trusted=args.trust)
    return load_model(args.model or "eha")


def list_signals(args: argparse.Namespace) -> list[str] | None:
    """The signals of --signals; None for all that the trace has."""
    return [name.strip() for name in args.signals.split(",")] if args.signals is not None else None


def format_arguments(args: argparse.Namespace) -> str:
    """The runs and the model of a command, as arguments of the command to type next."""
    options = {name: getattr(args, name, None) or []
               for name in ("repeat", "holdout", "model", "set", "effects", "signals", "faults")}
    words = [word for name, values in options.items() for value in (values if isinstance(values, list) else [values])
             for word in (f"--{name}", str(value))]
    return shlex.join([args.trace, *words, *(["--trust"] if args.trust else [])])


def is_suite_file(name: str) -> bool:
    """Whether a file is a suite and no sequence: it has the key `case`. False for what cannot be read."""
    try:
        return name.endswith(".toml") and "case" in read_toml(Path(name))
    except InputError:  # whoever reads it as a sequence says what is wrong
        return False

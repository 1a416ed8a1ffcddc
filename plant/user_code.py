"""Runs Python files of users: plants, effects, checksums, steps of a sequence."""

import contextlib
import hashlib
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from plant.errors import InputError

DECLARATIONS = ("signal", "segment", "effect ")  # begin where an InputError of a part of a file is


def run_file(path: Path, source: bytes) -> ModuleType:
    """Run a file as a module of its own; exactly these bytes run, and nothing that an import would have kept of it.

    Raises:
        InputError: it is not Python, or raises an exception; the error names the line.
    """
    module = ModuleType(f"{path.stem}_{hashlib.sha256(source).hexdigest()[:8]}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # where types, and annotations written as text, are looked up
    with explain_errors(str(path)):
        exec(compile(source, path, "exec", dont_inherit=True), module.__dict__)
    return module


@contextlib.contextmanager
def explain_errors(file: str, name: str = "") -> Iterator[None]:
    """Turn an exception of a user's code into bad input, with the last line of the file that it came through.

    So is a declaration refused that does not know its file: a signal, a segment, an effect.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr):  # standard output may be one JSON object
            yield
    except (Exception, SystemExit) as error:
        if isinstance(error, InputError) and not error.where.startswith(DECLARATIONS):
            raise
        if isinstance(error, SyntaxError) and error.filename == file:
            raise InputError(f"{file}:{error.lineno}", name, f"Python ({error.msg})") from error
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        text = ": ".join(filter(None, (type(error).__name__, " ".join(str(error).split()))))
        expected = f"code that runs without an exception, not {text}"
        if isinstance(error, InputError):
            name, expected = ", ".join(filter(None, (error.where, error.field))), error.expected
        raise InputError(f"{file}:{lines[-1]}" if lines else file, name, expected) from error

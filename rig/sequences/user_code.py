"""A user's own Python functions in a sequence: `python = "FILE.py:FUNCTION"`, a file beside the sequence.

The real-time loop runs no Python of the user's: his functions compute a part of the command before the run (a segment),
measure a number after it (a check), or run before the bus is opened and after the log is closed (a step). An error in
his code is bad input, with its file and line.
"""
from __future__ import annotations

import contextlib
import inspect
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

from plant.errors import InputError

Argument = float | str | bool
_NAME = re.compile(r"(\w[\w-]*\.py):([A-Za-z_]\w*)")


@dataclass(frozen=True)
class UserFunction:
    """A function of a user's file; `file` is where messages say that it stands."""

    file: str
    name: str
    function: Any

    def call(self, *values: object, **arguments: Argument) -> Any:
        """What the function returns.

        Raises:
            InputError: it raised an exception or ended the program; the error names file and line.
        """
        try:
            with contextlib.redirect_stdout(sys.stderr):  # standard output may be one JSON object
                return self.function(*values, **arguments)
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            raise explain_error(self.file, self.name, error) from error

    def require_arguments(self, given: int, arguments: Mapping[str, Argument]) -> None:
        """Refuse a function that does not take so many values and these named arguments.

        Raises:
            InputError: it names the function.
        """
        try:
            inspect.signature(self.function).bind(*range(given), **arguments)
        except TypeError as error:
            line = self.function.__code__.co_firstlineno if inspect.isfunction(self.function) else 1
            raise InputError(f"{self.file}:{line}", self.name,
                             f"a function of {describe_call(given, arguments)} ({error})") from error
        except ValueError:  # a function in C without a signature
            return


def describe_call(given: int, arguments: Mapping[str, Argument]) -> str:
    """How a function is called, in words."""
    named = f" and the arguments {', '.join(arguments)}" if arguments else ""
    return f"{given} value{'s' if given > 1 else ''}{named}"


def require_function_name(text: str) -> tuple[str, str]:
    """File and function of "FILE.py:FUNCTION".

    Raises:
        InputError: another text, or a file in another folder than the sequence.
    """
    match = _NAME.fullmatch(text)
    if match is None:
        raise InputError("python", "python", f"FILE.py:FUNCTION, a file beside the sequence, not {text!r}")
    return match[1], match[2]


@dataclass
class UserModules:
    """The user's files of one sequence; each runs once. `folder` is where messages say that they stand."""

    folder: Path
    modules: dict[str, ModuleType] = field(default_factory=dict)

    def find_function(self, file: str, source: bytes, name: str) -> UserFunction:
        """A function of a file with this source.

        Raises:
            InputError: the file cannot be run, or has no such function.
        """
        path = self.folder / file
        if file not in self.modules:
            self.modules[file] = run_file(path, source)
        function = getattr(self.modules[file], name, None)
        if not callable(function):
            raise InputError(path, name, "a function of this name in that file")
        return UserFunction(str(path), name, function)


def run_file(path: Path, source: bytes) -> ModuleType:
    """Run a user's file as a module of its own.

    Raises:
        InputError: it is not Python, or raises an exception; the error names the line.
    """
    module = ModuleType(f"steps_of_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # where dataclasses look up their annotations
    try:
        with contextlib.redirect_stdout(sys.stderr):
            exec(compile(source, str(path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        raise explain_error(str(path), "", error) from error
    return module


def explain_error(file: str, name: str, error: BaseException) -> InputError:
    """An exception of a user's code as bad input, with the last line of his file that it came through."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return InputError(f"{file}:{error.lineno}", name, f"Python ({error.msg})")
    line = _find_line(error.__traceback__, file)
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return InputError(f"{file}:{line}" if line else file, name, f"code that runs without an exception, not {text}")


def _find_line(trace: TracebackType | None, file: str) -> int:
    line = 0
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == file:
            line = trace.tb_lineno
        trace = trace.tb_next
    return line

"""`rig COMMAND`: finds the command's module, shows errors as one line, turns them into exit statuses."""
from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import os
import pkgutil
import sys
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from types import ModuleType
from typing import Any, NoReturn

from plant.errors import RigError
from rig.cli import commands

INTERNAL = 70  # EX_SOFTWARE of sysexits.h
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """An argparse parser whose complaint is one line, and which takes a command's files before and after options."""

    _within = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """In place of argparse's, which takes no second word after an option: `rig add EFFECT --model FILE TRACE`."""
        if self._subparsers is not None or self._within:
            return super().parse_known_args(args, namespace)
        self._within = True
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._within = False

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} ({self.prog} --help)\n")


def command_modules() -> dict[str, ModuleType]:
    """Name of each command to its module: HELP, add_arguments(parser), run(args) -> exit status."""
    names = sorted(module.name for module in pkgutil.iter_modules(commands.__path__))
    return {name.rstrip("_"): importlib.import_module(f"rig.cli.commands.{name}") for name in names}


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    top = _Parser(prog="rig", description="Hardware-in-the-loop rig for an electrohydraulic actuator.",
                  epilog="rig COMMAND --help tells more. Exit status: 0 passed, 1 not passed, 2 bad input, "
                         "3 timing invalid, 130 interrupted.")
    top.add_argument("--version", action="version", version=f"eha-rig {version('eha-rig')}")
    below = top.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for name, module in command_modules().items():
        sub = below.add_parser(name, help=module.HELP, description=(module.run.__doc__ or module.HELP).split("\n")[0])
        module.add_arguments(sub)
        sub.add_argument("--json", action="store_true", help="one JSON object on standard output, nothing else there")
        sub.add_argument("--out", metavar="PATH", help="where the result goes")
        sub.add_argument("--quiet", action="store_true", help="no progress, no tables")
        sub.set_defaults(run=module.run)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """The entry point; returns the exit status."""
    args = parser().parse_args(argv)
    status: int = 0
    try:
        status = args.run(args)
        print(end="", flush=True)  # here, where a pipe that broke can be told; there may be no standard output at all
        return status
    except RigError as error:
        return _complain(args, str(error), error.status)
    except KeyboardInterrupt:
        return _complain(args, "interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader of a pipe has gone: nothing to say, and nobody to say it to
        _speak_no_more()
        return status
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            _speak_no_more()
            return _complain(args, f"no space left for the answer or the results ({error.strerror})", 2)
        traceback.print_exc()  # a bug of ours: Python's own exit status 1 would read as a failed check
        return INTERNAL


def _speak_no_more() -> None:
    """Standard output leads nowhere any more; what is still in its buffer must not end the program in an error."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(args: argparse.Namespace, message: str, status: int) -> int:
    print(f"rig {args.command}: " + " ".join(message.split()), file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())

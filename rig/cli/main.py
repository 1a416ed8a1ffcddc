# PYTHON_ARGCOMPLETE_OK
"""`rig COMMAND`: parse the command line, run the command, report errors in one line, return the exit status."""
from __future__ import annotations

import argparse
import atexit
import contextlib
import errno
import gc
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from plant.errors import RigError, escape_control_characters
from rig.cli.answer import discard_output
from rig.cli.command_list import HELP_OF_COMMAND, import_command

FIRST_STEPS = """\
rig tests the controller of an electrohydraulic actuator and analyses its recordings. To begin:

    rig run                      run the preflight check on the embedded bus: a few seconds, no hardware
    rig report runs/preflight    write its page; open runs/preflight/report.html in a browser
    rig simulate --out run.csv   make a recording of the nominal actuator
    rig compare run.csv          compare a model with a recording
    rig list parameters          what --set takes; also signals, sequences, effects, checks, models
    rig doctor                   what this machine can do

rig --help lists all commands, rig COMMAND --help the options of one."""
INTERNAL = 70  # EX_SOFTWARE of sysexits.h
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """An argparse parser that reports a usage error in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} ({self.prog} --help)\n")


class _CommandParser(_Parser):
    """The parser of one command. It imports the command when it is asked to parse, and accepts files after options."""

    _is_loaded = False
    _is_parsing = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Replace argparse's method, which rejects a file after an option: `rig add EFFECT --model FILE TRACE`."""
        self._load()
        if self._is_parsing:
            return super().parse_known_args(args, namespace)
        self._is_parsing = True
        try:
            parsed, unknown = self.parse_known_intermixed_args(args, namespace)
        finally:
            self._is_parsing = False
        if unknown:  # reported here, because the parser above this one would name `rig` without the command
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def _load(self) -> None:
        """Import the command and add its options, once."""
        if self._is_loaded:
            return
        self._is_loaded = True
        name = self.prog.split()[-1]
        module = import_command(name)
        what, result = HELP_OF_COMMAND[name], (module.run_command.__doc__ or "").split("\n")[0]
        self.description = f"{what[0].upper()}{what[1:]}. {result}"
        module.add_arguments(self)
        self.add_argument("--json", action="store_true", help="print one JSON object on standard output, nothing else")
        self.add_argument("--out", metavar="PATH", help="where to write the result")
        self.add_argument("--quiet", action="store_true", help="print nothing but errors")
        self.set_defaults(run_command=module.run_command)


class _PrintVersion(argparse.Action):
    """`--version`: reads the package metadata only when asked, because that takes 40 ms."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from importlib.metadata import version

        print(f"eha-rig {version('eha-rig')}")
        parser.exit()


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of the whole command line; a command's own options are added when it is parsed."""
    parser = _Parser(prog="rig", description="Hardware-in-the-loop rig for an electrohydraulic actuator.",
                     epilog="For the options of a command: rig COMMAND --help. Exit status: 0 passed, 1 not passed, "
                            "2 bad input, 3 timing invalid, 70 internal error, 130 interrupted.")
    parser.add_argument("--version", action=_PrintVersion, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_CommandParser)
    for name, help_text in HELP_OF_COMMAND.items():
        commands.add_parser(name, help=help_text)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status. Without `argv` it is the program, which ends right after this."""
    if argv is None and "_ARGCOMPLETE" in os.environ:
        from rig.cli.completion import complete_line

        complete_line()
    if argv is None:
        gc.set_threshold(50_000)  # 0.05 s less: most objects are made while modules load, and stay
        leave_out_reader(sys.argv[1:])
        leave = leave_quickly()
        status = leave(run_command_line(sys.argv[1:]))
        if status == INTERRUPTED and _are_fits_at_work():
            sys.stderr.flush()
            os._exit(status)  # Python would wait for the threads
        return status
    return run_command_line(argv)


def _are_fits_at_work() -> bool:
    """Whether threads are left that compute for a command that was interrupted."""
    from plant.threads import THREAD_NAME

    return any(t.name.startswith(THREAD_NAME) for t in threading.enumerate())


def leave_out_reader(words: Sequence[str]) -> None:
    """Keep python-can from loading asammdf (0.9 s, where it is installed): only `rig import` reads MF4 files."""
    if words[:1] != ["import"]:
        sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]  # None: an import of it fails


def leave_quickly() -> Callable[[int], int]:
    """Let the program end without taking its modules apart, which takes up to a second with compiled code in memory.

    The function returned takes the exit status and returns it. Everything registered with `atexit` after this call
    still runs.
    """
    known: list[int] = []

    def leave() -> None:
        if not known:  # an exception or sys.exit ends the program: Python finds the status
            return
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, or none
                stream.flush()
        os._exit(known[0])

    def note(status: int) -> int:
        known.append(status)
        return status

    atexit.register(leave)
    return note


def run_command_line(argv: Sequence[str]) -> int:
    """Run the command of a command line; return its exit status."""
    if not argv:
        print(FIRST_STEPS, flush=True)
    args = build_parser().parse_args(argv)
    status: int = 0
    try:
        status = args.run_command(args)
        print(end="", flush=True)  # here, so that a closed pipe is reported below; there may be no standard output
        return status
    except RigError as error:
        return _report_error(args, str(error), error.status)
    except KeyboardInterrupt:
        return _report_error(args, "interrupted", INTERRUPTED)
    except BrokenPipeError:  # whoever read our output has stopped reading: nothing to report, nobody to report it to
        discard_output()
        return status
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            discard_output()
            return _report_error(args, f"no space left for the output or the results ({error.strerror})", 2)
        from traceback import print_exc

        print_exc()  # an internal error; Python's own exit status 1 would read as a failed check
        return INTERNAL


def _report_error(args: argparse.Namespace, message: str, status: int) -> int:
    print(f"rig {args.command}: {escape_control_characters(' '.join(message.split()))}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())

# PYTHON_ARGCOMPLETE_OK
"""`rig COMMAND`: parse the command line, run the command, report errors in one line, return the exit status."""

import argparse
import atexit
import contextlib
import ctypes
import errno
import gc
import os
import sys
import threading
from collections.abc import Sequence
from io import TextIOWrapper
from typing import Any, NoReturn

from plant import RigError, escape_control_characters
from rig.cli.answer import discard_output
from rig.cli.command_list import COMMANDS, OF_EVERY_COMMAND, add_options, find_work
from rig.interrupts import repeat_lost_interrupts

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
# What the system has against a name or place that the user chose; anything else may be a bug.
REFUSALS = {errno.ENAMETOOLONG, errno.ELOOP, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES}


class _Parser(argparse.ArgumentParser):
    """An argparse parser that reports a usage error in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} ({self.prog} --help)\n")


class _PrintVersion(argparse.Action):
    """`--version`: reads the package metadata only when asked, because that takes 40 ms."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from importlib.metadata import version

        print(f"eha-rig {version('eha-rig')}")
        parser.exit()


def build_parser(command_name: str = "") -> argparse.ArgumentParser:
    """Build the parser of `rig` with all commands; only the command of this name has its options."""
    parser = _Parser(prog="rig", description="Hardware-in-the-loop rig for an electrohydraulic actuator.",
                     epilog="For the options of a command: rig COMMAND --help. Exit status: 0 passed, 1 not passed, "
                            "2 bad input, 3 timing invalid, 70 internal error, 130 interrupted.")
    parser.add_argument("--version", action=_PrintVersion, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        command_parser = commands.add_parser(name, help=command.help)
        if name == command_name:
            add_options(command_parser, (*command.options, *OF_EVERY_COMMAND))
    return parser


def build_command_parser(name: str) -> argparse.ArgumentParser:
    """Build the parser of the words behind the name of a command."""
    command = COMMANDS[name]
    parser = _Parser(prog=f"rig {name}", description=f"{command.help[0].upper()}{command.help[1:]}. {command.result}")
    add_options(parser, (*command.options, *OF_EVERY_COMMAND))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status. Without `argv` it is the program, which ends right after this."""
    if argv is not None:
        return run_command_line(argv)
    if "_ARGCOMPLETE" in os.environ:
        from rig.cli.completion import complete_line

        complete_line()
    sys.stderr = sys.stderr or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")  # None where it is closed
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a character that its encoding lacks must not end a run
    if os.environ.get("COLUMNS") == "0":  # not known, as in POSIX; rich would print nothing
        del os.environ["COLUMNS"]
    gc.set_threshold(50_000)  # 0.05 s less: most objects are made while modules load, and stay
    leave_out_reader(sys.argv[1:])
    keep_memory()
    repeat_lost_interrupts()
    statuses: list[int] = []
    atexit.register(leave_quickly, statuses)
    statuses.append(run_command_line(sys.argv[1:]))
    if statuses == [INTERRUPTED] and _are_fits_at_work():
        leave_quickly(statuses)  # Python would wait for the threads
    return statuses[0]


def _are_fits_at_work() -> bool:
    """Whether threads are left that compute for a command that was interrupted."""
    from plant import THREAD_NAME

    return any(t.name.startswith(THREAD_NAME) for t in threading.enumerate())


def leave_out_reader(words: Sequence[str]) -> None:
    """Keep python-can from loading asammdf (0.9 s, where it is installed): only `rig import` reads MF4 files."""
    if words[:1] != ["import"]:
        sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]  # None: an import of it fails


def keep_memory() -> None:
    """Keep the memory of arrays that are done with for the next ones, where the C library is glibc.

    It gives large pieces back to the kernel, which has to clear them before it hands them out again: a twentieth of
    the time of an explain, and a tenth of its memory, as each thread has pieces of its own.
    """
    trim_threshold, mmap_threshold, most_arenas = -1, -3, -8  # M_.. of malloc.h
    if (choose := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        for option, value in ((trim_threshold, 2**31 - 1), (mmap_threshold, 2**30), (most_arenas, 2)):
            choose(option, value)


def leave_quickly(statuses: Sequence[int]) -> None:
    """End the program without taking its modules apart, which takes up to a second with compiled code in memory.

    Args:
        statuses: the exit status. Empty: an exception or sys.exit ends the program, and Python finds the status.
    """
    if statuses:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, or none
                stream.flush()
        os._exit(statuses[0])


def run_command_line(words: Sequence[str]) -> int:
    """Run the command of a command line; return its exit status."""
    if not words:
        print(FIRST_STEPS, flush=True)
    if not words or words[0] not in COMMANDS:
        build_parser().parse_args(words[:1])  # help, version, or an error: it ends here
    name = words[0]
    args = build_command_parser(name).parse_intermixed_args(words[1:])  # files may stand behind options
    if any("\ud800" <= letter <= "\udfff" for letter in "".join(words)):  # such a name fits no log and no page
        return _report_error(name, "expected names of files in UTF-8", 2)
    status = 0
    try:
        status = find_work(name)(args)
        print(end="", flush=True)  # here, so that a closed pipe is reported below; there may be no standard output
        return status
    except RigError as error:
        return _report_error(name, str(error), error.status)
    except KeyboardInterrupt as error:
        return _report_error(name, str(error) or "interrupted", INTERRUPTED)
    except BrokenPipeError:  # whoever read our output has stopped reading: nothing to report, nobody to report it to
        discard_output()
        return status
    except Exception as error:
        if isinstance(error, OSError) and error.errno in REFUSALS:
            discard_output()
            return _report_error(name, f"{error.filename or 'the output or the results'}: expected a file that the "
                                       f"system accepts ({error.strerror})", 2)
        from traceback import print_exc

        from plant import find_compile_error

        # a user's plant file is compiled where it is first needed
        if (compile_error := find_compile_error(error)) is not None:
            return _report_error(name, str(compile_error), compile_error.status)
        print_exc()  # an internal error; Python's own exit status 1 would read as a failed check
        return INTERNAL


def _report_error(command: str, message: str, status: int) -> int:
    print(f"rig {command}: {escape_control_characters(' '.join(message.split()))}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())

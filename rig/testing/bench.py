"""The bench for tests in Python: runs in lockstep on the embedded bus, and what they measured."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.output import write_text
from fdi.progress import ignore_progress
from fdi.report import (
    draw_failed_check,
    draw_signals,
    write_run_page,
)
from fdi.trace import CheckResult, Event, Trace
from plant import RATE, InputError, find_plant, quote_text, require, suggest_name
from rig.run import JobChoice, Outcome, build_job, load_tested_plant, run_job
from rig.sequences import Sequence as TestSequence, load_sequence, parse_sequence


class CheckFailedError(AssertionError):
    """A run did not pass; the message names each check that failed, and the files that show it."""


@dataclass(frozen=True)
class BenchRun:
    """A run on the bench."""

    folder: Path  # of trace.mcap and verdict.json
    outcome: Outcome = field(repr=False)

    @property
    def verdict(self) -> str:
        """PASS, FAIL, CANNOT_TELL, ABORTED or NOT_JUDGED (no checks)."""
        return self.outcome.verdict

    @property
    def why(self) -> str:
        """The reason of a verdict other than PASS."""
        return self.outcome.why

    @property
    def checks(self) -> dict[str, CheckResult]:
        """The checks of the sequence and the protocol checks, by name."""
        return {check.name: check for check in self.outcome.checks}

    @property
    def events(self) -> Sequence[Event]:
        """What happened, in order."""
        return self.outcome.events

    @cached_property
    def trace(self) -> Trace:
        """The main phase: columns t, com, xj, cor, p12, xs, load, SI units."""
        return Trace.read(self.folder / "trace.mcap")

    def write_page(self) -> Path:
        """Write report.html, the page of the run, into its folder; return its path."""
        page = self.folder / "report.html"
        if not page.exists():
            write_run_page(self.folder / "trace.mcap", page)
        return page

    def write_picture(self) -> Path:
        """Write signals.svg, the signals over time with the windows of the checks, into the folder of the run."""
        picture = self.folder / "signals.svg"
        write_text(picture, draw_signals(Trace.read(self.folder / "trace.mcap", all=True)))
        return picture

    def write_close_up(self, name: str) -> Path | None:
        """Write a close-up of a check, its window with limits and measured value, into the folder of the run.

        Returns:
            The SVG file; None for a check that has no window or no signal.

        Raises:
            InputError: a name that no check has.
        """
        trace = Trace.read(self.folder / "trace.mcap", all=True)
        drawing = draw_failed_check(trace, self._find_check(name))
        if not drawing:
            return None
        picture = self.folder / f"check-{re.sub(r'[^a-zA-Z0-9_.=+-]+', '-', name).strip('-')}.svg"
        write_text(picture, drawing)
        return picture

    def _find_check(self, name: str) -> CheckResult:
        __tracebackhide__ = True
        require(name in self.checks, "check", name, f"the name of a check of this run{suggest_name(name, self.checks)}")
        return self.checks[name]

    def assert_passed(self, *names: str) -> None:
        """Fail a test unless these checks passed; without names, unless the run passed.

        Raises:
            CheckFailedError: it names the checks that failed with limits and measured values, and a picture.
            InputError: a name that no check has.
        """
        __tracebackhide__ = True
        checks = [*map(self._find_check, names)] if names else list(self.outcome.checks)
        failed_checks = [check for check in checks if not check.passed]
        if not failed_checks and (names or self.verdict in ("PASS", "NOT_JUDGED")):
            return
        title = self.outcome.job.sequence.title
        lines = [f"{title}: {len(failed_checks)} of {len(checks)} checks not passed" if failed_checks else
                 f"{title}: {self.verdict}, {self.why}", *map(describe_failure, failed_checks)]
        close_ups = [picture for check in failed_checks[:3] if (picture := self.write_close_up(check.name)) is not None]
        pictures = [f"picture: {picture}" for picture in close_ups or [self.write_picture()]]
        raise CheckFailedError("\n".join([*lines, *pictures, f"page: {self.write_page()}"]))


def describe_failure(check: CheckResult) -> str:
    """A failed check in one line: name, measured value, limits, window, requirement."""
    window = f"{check.t0:.3f} to {check.t1:.3f} s" if check.t0 == check.t0 else ""
    requirement = f"requirement {check.requirement}" if check.requirement else ""
    return f"{check.name}: {', '.join(filter(None, (check.describe(), window, check.detail, requirement)))}"


Table = Mapping[str, Any]
Command = NDArray[np.float64] | Sequence[float] | Sequence[Table]


@dataclass
class Bench:
    """Runs sequences in lockstep on the embedded bus; the results of each run go to a folder below `folder`.

    `model` is the model of runs that do not choose one: a file, or the name of a shipped one.
    """

    folder: Path
    model: str | None = None
    runs: list[BenchRun] = field(default_factory=list)

    def run(self, sequence: str | Path | None = None, *, command: Command | None = None,
            set: Mapping[str, float | str] | None = None, model: str | Path | None = None, seed: int = 0,
            effects: Sequence[str | Path] = (), faults: Sequence[Table] = (), checks: Sequence[Table] = (),
            load: Sequence[Table] = (), guards: Sequence[Table] = (), bench: str | Path = "eha") -> BenchRun:
        """Run a sequence, or a command built in Python.

        Args:
            sequence: a file, or the name of a shipped one (default: preflight).
            command: in its place, a demand for each cycle of the bench, or a list of segments as tables.
            set: parameters of the model or of effects, SI: {"filter.clogging": 0.5}.
            model: a file, or the name of a shipped one; default: that of the bench, else that of the sequence.
            seed: of the noise.
            effects: files of your own effects.
            faults, checks, load, guards: entries as tables, as in a sequence file; added to those of the sequence.
            bench: a bench file, or the name of a shipped one.

        Raises:
            InputError: what cannot be used.
        """
        __tracebackhide__ = True  # pytest shows the line of the test
        folder = self.folder / f"run-{len(self.runs) + 1}"
        try:
            require(set is None or isinstance(set, Mapping), "set", "", 'values by parameter: {"filter.clogging": 0.5}')
            model_name = self.model if model is None else str(model)
            choice = JobChoice("", model_name, set or {}, seed, tuple(map(Path, effects)), str(bench))
            tested, plant = load_tested_plant(choice)
            test_sequence = build_sequence(None if sequence is None else str(sequence), command, tested.rate, plant,
                                           faults=faults, checks=checks, load=load, guards=guards)
            job = build_job(choice._replace(sequence=test_sequence.name), test_sequence)
            run = BenchRun(folder, run_job(job, folder, ignore_progress, lambda: False))
        except InputError as error:
            raise InputError(error.where, error.field, error.expected) from None
        self.runs.append(run)
        return run


_COMMAND_FILE = "command.csv"


def build_sequence(sequence: str | None, command: Command | None, rate: float = RATE, plant: str = "eha",
                   **more: Sequence[Table]) -> TestSequence:
    """A sequence from a file or name, or from a command.

    Args:
        sequence: a file, or the name of a shipped sequence.
        command: in its place, a demand for each cycle, or a list of segments as tables.
        rate: cycles a second.
        plant: that it tests.
        more: entries as tables that are added to those of the sequence, by key: faults, checks, guards, load.

    Raises:
        InputError: a sequence or entry that cannot be used.
    """
    additions = {key: list(entries) for key, entries in more.items() if len(entries)}
    if command is None:
        base = load_sequence("preflight" if sequence is None else sequence, rate, plant)
        if not additions:
            return base
        table, files, name = tomllib.loads(base.source), dict(base.files), base.name
    else:
        require(sequence is None, "sequence", str(sequence), "either a sequence or a command")
        table, files = _make_table(command, rate, find_plant(plant).signals.command.name)
        name = "command.toml"
    table |= {key: [*table.get(key, []), *entries] for key, entries in additions.items()}

    def read_file(file: str) -> bytes:
        require(file in files, file, "", "a file of the sequence")
        return files[file]

    return parse_sequence(write_toml(table), name, read_file, rate, plant)


def _make_table(command: Command, rate: float, column: str) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The table of a sequence that plays a command, and its files."""
    main: Any = list(command) if isinstance(command, Sequence) or np.ndim(command) == 1 else [None]
    files = {}
    if not any(isinstance(part, Mapping) for part in main):
        require(all(isinstance(value, Real) for value in main), "command", "",
                "a demand for each cycle, all of them real numbers, or a list of segments as tables")
        rows = "\n".join(f"{k / rate!r},{float(value)!r}" for k, value in enumerate(main))
        main = [{"name": "command", "kind": "csv", "file": _COMMAND_FILE}]
        files[_COMMAND_FILE] = f"t,{column}\n{rows}\n".encode()
    return {"title": "Command from Python", "main": main}, files


def write_toml(table: Table) -> str:
    """A table as TOML text, one line for each of its keys.

    Raises:
        InputError: a value that TOML cannot hold.
    """
    return "".join(f"{_write_key(key)} = {_write_value(value)}\n" for key, value in table.items())


def _write_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else quote_text(key)


def _write_value(value: object) -> str:
    value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    if isinstance(value, str):
        return quote_text(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        pairs = ", ".join(f"{_write_key(str(key))} = {_write_value(inner)}" for key, inner in value.items())
        return f"{{ {pairs} }}"
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_write_value, value))}]"
    raise InputError("sequence", "", f"numbers, texts, lists and tables, not {type(value).__name__}")

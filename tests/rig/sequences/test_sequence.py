"""Sequences from TOML: what a good one says, a bad one is told; the fault schedule: what is wrong in which cycle."""

import json
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT
from refusals import catch_refusal

from fdi.trace import CheckResult
from plant import InputError, load_model, simulate, tables
from rig.benches import load_bench
from rig.network import Identity
from rig.nodes import Scenario
from rig.sequences import (
    CUT,
    DELAY,
    DOUBLE,
    DROP,
    BusOff,
    Corrupted,
    Fault,
    Foreign,
    Jitter,
    Late,
    Noise,
    Offset,
    Parameter,
    Plan,
    Reset,
    Schedule,
    Sequence,
    Short,
    Silent,
    Stuck,
    change_frame,
    evaluate_checks,
    faults,
    load_sequence,
    parse_sequence,
    require_possible,
)
from rig.sequences.faults import CORRUPT, NORMAL, Action, Duplicated, Lost

FULL = """\
title = "All of it"
setup = [{ kind = "ramp", to = 1e-3, time = 0.2 }]
main = [
  { kind = "hold", time = 0.5 },
  { name = "up", kind = "step", to = 2e-3, time = 0.5 },  # a comment with ] and "
  { name = "taped", kind = "csv", file = "tape.csv" },
]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.1 }]
load = [{ kind = "points", points = [[0.1, 1000.0], [0.2, 500]] }]
faults = [
  { kind = "parameter", parameter = "filter.clogging", value = 0.25, start = 0.5, end = 0.8, ramp = 0.1 },
  { name = "gone", kind = "lost", frame = "drive", start = 0.9, count = 3 },
]
checks = [
  { name = "overshoot", kind = "overshoot", window = "up", high = 10 },
  { name = "emergency", kind = "response_within", after = "gone", event = "EMCY 0x8250", high = 10, unit = "ms" },
]
guards = [{ name = "far", signal = "xj", high = 0.01 }]

[model]
overrides = { spool.static_friction = 35, "null_bias.current" = 1e-4 }
"""
TAPE = b"t,com\n0,0.002\n0.001,0.001\n0.002,0\n"


def tape(name: str) -> bytes:
    if name != "tape.csv":
        raise InputError(name, "", "a file that can be read (No such file or directory)")
    return TAPE


def parse(text: str) -> Sequence:
    return parse_sequence(text, "mine.toml", tape)


def test_a_full_sequence_says_what_the_file_says() -> None:
    s = parse(FULL)
    assert (s.title, s.name, s.duration, s.ends) == ("All of it", "mine.toml", 1.003, "completed")
    assert s.model.overrides == {"spool.static_friction": 35.0, "null_bias.current": 1e-4}
    command, force = s.build_main_profile().command, s.build_load_profile()
    # main goes on where set-up ended
    assert command[[0, 500, 1000, 1001, 1002]].tolist() == [1e-3, 2e-3, 0.002, 0.001, 0.0]
    assert s.sections() == {"hold_1": slice(0, 500), "up": slice(500, 1000), "taped": slice(1000, 1003)}
    assert s.build_cleanup_profile(5e-3).command[0] == 5e-3
    assert len(force) == 1003 and force[50] == 500.0 and force[100] == 1000.0 and (force[200:] == 500.0).all()
    plan = s.plan(seed=3)
    assert (plan.start, plan.stop, plan.seed) == (200, 1203, 3)
    assert s.fault_starts() == {"parameter filter.clogging": 0.5, "gone": 0.9}


def test_a_sequence_is_repeated_from_its_bundle_alone() -> None:
    s = parse(FULL)
    assert s.bundle() == {"mine.toml": FULL.encode(), "tape.csv": TAPE}
    assert Sequence.from_bundle(s.bundle()) == s
    assert "one .toml file" in catch_refusal(Sequence.from_bundle, {})
    assert "tape.csv: expected to be part of the bundle" in catch_refusal(
        Sequence.from_bundle, {"mine.toml": FULL.encode()})


def test_files_are_found_beside_the_sequence_and_names_among_the_shipped_ones(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(FULL)
    (tmp_path / "tape.csv").write_bytes(TAPE)
    assert load_sequence(tmp_path / "mine.toml") == parse(FULL)
    (tmp_path / "mine.toml").write_bytes(b"title = '\xff'")
    for name, words in ((str(tmp_path / "mine.toml"), "UTF-8"), ("preflihgt", "(did you mean 'preflight'?)"),
                        (tmp_path / "other.toml", "other.toml: expected a file that can be read")):
        assert words in catch_refusal(load_sequence, name)


HEAD = 'title = "T"\nmain = [{ kind = "hold", time = 1.0 }]\n'
BAD = [  # text, then what the user reads
    ("title = \n", "mine.toml:1: expected TOML; invalid value"),
    ('title = "T"\n\nmain = [\n', "mine.toml:4: expected TOML;"),
    ('main = [{ kind = "hold", time = 1.0 }]\n', "mine.toml: expected also the key 'title', a text"),
    ('title = "T"\nmain = []\n', "mine.toml:2: main: expected at least one segment"),
    ('title = 3\nmain = []\n', "mine.toml:1: title: expected a text, not 3"),
    ('title = "T"\nmain = { kind = "hold" }\n',
     "mine.toml:2: main: expected a list, each a table, not {'kind': 'hold'}"),
    (HEAD + "cheks = []\n", "mine.toml:3: cheks: expected a key: "),
    (HEAD + "cheks = []\n", "not 'cheks' (did you mean 'checks'?)"),
    (HEAD + 'source = "x"\n', "mine.toml:3: source: expected a key: "),
    ('title = "T"\nmain = [\n  { kind = "hold", time = 1 },\n  { kind = "stepp", to = 1, time = 1 },\n]\n',
     "mine.toml:4: main[1].kind: expected a kind: 'chirp', 'csv', 'hold', 'multisine', 'points', 'python', 'ramp', "
     "'sine' or 'step', not 'stepp' (did you mean 'step'?)"),
    ('title = "T"\nmain = [{ time = 1 }]\n', "mine.toml:2: main[0]: expected a kind: 'chirp', 'csv'"),
    ('title = "T"\nmain = [{ kind = [], time = 1 }]\n', "mine.toml:2: main[0].kind: expected a kind: 'chirp', 'csv'"),
    ('title = "T"\nmain = [{ kind = "step", time = 1 }]\n',
     "mine.toml:2: main[0]: expected also the key 'to', a number in m (N for a load)"),
    ('title = "T"\nmain = [{ kind = "step", to = "far", time = 1 }]\n',
     "mine.toml:2: main[0].to: expected a number in m (N for a load), not 'far'"),
    ('title = "T"\nmain = [{ kind = "hold", tiem = 1 }]\n', "(did you mean 'time'?)"),
    ('title = "T"\nmain = [{ kind = "hold", time = true }]\n',
     "mine.toml:2: main[0].time: expected a number in s, not True"),
    ('title = "T"\nmain = [{ kind = "hold", time = nan }]\n', "main[0].time: expected a number in s, not nan"),
    ('title = "T"\nmain = [{ kind = "hold", time = -1 }]\n',
     "main[0].time: expected above 0 and at most 3600 s, not -1"),
    ('title = "T"\n[[main]]\nkind = "hold"\ntime = 1\n\n[[main]]\nkind = "hold"\ntime = 0.00001\n',
     "mine.toml:8: main[1].time: expected whole cycles of 0.001 s, not 1e-05"),
    ('title = "T"\nmain = [\n{ kind = "hold", time = 1, name = "a" },\n{ kind = "hold", time = 1, name = "a" }]\n',
     "mine.toml:4: main[1].name: expected a name used once, not a second 'a'"),
    ('title = "T"\nmain = [{ kind = "hold", time = 1, name = "main" }]\n',
     "mine.toml:2: main[0].name: expected another name than 'main'"),
    ('title = "T"\nmain = [{ kind = "csv", file = "no.csv" }]\n',
     "mine.toml:2: main[0].file: expected a readable command file; no.csv: expected a file that can be read"),
    (HEAD + 'load = [{ kind = "csv", file = "tape.csv" }]\n',
     "load[0].file: expected a file with the columns t and value"),
    (HEAD + 'load = [{ kind = "hold", time = 2 }]\n',
     "mine.toml:3: load: expected at most the 1 s that main lasts, not 2 s"),
    ('title = "T"\nmain = [\n{ kind = "hold", time = 1 },\n{ kind = "ramp", to = 5, time = 1 }]\n',
     "mine.toml:4: main[1]: expected at most 1 m either way, not 5"),
    ('title = "T"\nmain = [{ kind = "sine", amplitude = 1e308, frequency = 1, time = 1 }]\n',
     "mine.toml:2: main[0]: expected at most 1 m either way, not 1e+308"),
    (HEAD + 'setup = [{ kind = "step", to = -1e308, time = 1 }, { kind = "ramp", to = 1e308, time = 1 }]\n',
     "mine.toml:3: setup[0]: expected at most 1 m either way, not 1e+308"),
    (HEAD + 'load = [{ kind = "hold", time = 0.5 }, { kind = "step", to = -2e6, time = 0.5 }]\n',
     "mine.toml:3: load[1]: expected at most 1e+06 N either way, not 2e+06"),
    (HEAD + 'load = [{ kind = "points", points = [[0, 1, 2]] }]\n',
     "mine.toml:3: load[0].points[0]: expected [a number, a number], not [0, 1, 2]"),
    (HEAD + 'plant = "none.py"\n', "mine.toml:3: plant: expected one of eha, ehs, ema, or a Python file that exists"),
    (HEAD + 'faults = [{ kind = "parameter", parameter = "filter.cloging", value = 1, start = 0 }]\n',
     "mine.toml:3: faults[0].parameter: expected a field of filter"),
    (HEAD + 'faults = [{ kind = "parameter", parameter = "filter.clogging", value = 1.5, start = 0 }]\n',
     "mine.toml:3: faults[0].value: expected a number from 0 and below 1"),
    (HEAD + 'faults = [\n{ kind = "parameter", parameter = "controller.period", value = 0.002, start = 0 }]\n',
     "mine.toml:4: faults[0].parameter: expected a parameter of the plant, not 'controller.period': the controller is "
     "the thing under test, no fault reaches into it"),
    (HEAD + 'faults = [{ kind = "parameter", parameter = "asymmetric_gain.retraction", value = 0.1, start = 0 }]\n',
     "mine.toml:3: faults[0].parameter: expected a parameter of the plant, not 'asymmetric_gain.retraction'"),
    (HEAD + 'faults = [{ kind = "parameter", parameter = "filter.law", value = 0.7, start = 0 }]\n',
     "mine.toml:3: faults[0].value: expected one of sqrt, linear, pressure, not 0.7"),
    (HEAD + 'faults = [{ kind = "parameter", parameter = "filter.law", value = "cubic", start = 0 }]\n',
     "mine.toml:3: faults[0].value: expected one of sqrt, linear, pressure, not 'cubic'"),
    (HEAD + 'faults = [{ kind = "parameter", parameter = "filter.law", value = "linear", start = 0, ramp = 0.1 }]\n',
     "mine.toml:3: faults[0].ramp: expected none: filter.law is one of sqrt, linear, pressure, with nothing between"),
    (HEAD + 'faults = [\n{ kind = "parameter", parameter = "spool.dynamic_friction", value = 9, start = 0.2 }]\n',
     "mine.toml:4: faults[0]: expected spool.dynamic_friction at most spool.static_friction (5 N), not 9 at 0.2 s"),
    (HEAD + 'faults = [\n{ kind = "parameter", parameter = "spool.static_friction", value = 9, start = 0, end = 0.5 },'
     '\n{ kind = "parameter", parameter = "spool.dynamic_friction", value = 8, start = 0.1 }]\n',
     "mine.toml:4: faults[0]: expected spool.dynamic_friction at most spool.static_friction (5 N), not 8 at 0.5 s"),
    (HEAD + 'faults = [{ kind = "offset", signal = "xj", value = 1e300, start = 0 }]\n',
     "mine.toml:3: faults[0].value: expected a number from -1e+12 to 1e+12 SI units, not 1e+300"),
    (HEAD + 'faults = [{ kind = "stuck", signal = "xj", start = 0, end = 1e308 }]\n',
     "mine.toml:3: faults[0].end: expected a number from 0 to 1e+06 s, not 1e+308"),
    (HEAD + 'faults = [{ kind = "lost", frame = "drive", start = 0, every = 1000000000000000000000 }]\n',
     "mine.toml:3: faults[0].every: expected a whole number from 1 to 1000000000, not 1000000000000"),
    (HEAD + '[model]\noverrides = { filter.law = "cubic" }\n',
     "mine.toml:4: model.overrides.filter.law: expected one of sqrt, linear, pressure, not 'cubic'"),
    (HEAD + '[model]\noverrides = { spool.static_friction = 2 }\n',
     "mine.toml:4: model.overrides: expected spool.dynamic_friction at most spool.static_friction (2 N), not 3.33333"),
    (HEAD + 'faults = [{ kind = "lost", frame = "drives", start = 0 }]\n',
     "faults[0].frame: expected 'command', 'drive', 'feedback', 'sync' or 'valve_state', not 'drives' (did you mean "
     "'drive'?)"),
    (HEAD + 'faults = [{ kind = "late", frame = "sync", delay = 1e-4, start = 0 }]\n',
     "faults[0].frame: expected 'command', 'drive', 'feedback' or 'valve_state', not 'sync'"),
    (HEAD + 'faults = [{ kind = "short", frame = "drive", length = 8, start = 0 }]\n',
     "faults[0].length: expected a whole number from 0 to 7, not 8"),
    (HEAD + 'faults = [{ kind = "jitter", size = 1e-3, start = 0 }]\n',
     "faults[0].size: expected a time below a cycle, 0.001 s, not 0.001"),
    (HEAD + 'faults = [{ kind = "bus_off", node = "controller", start = 0 }]\n',
     "faults[0].node: expected 'plant' or 'rig', not 'controller'"),
    (HEAD + '[protocol]\nstatus = 0\n', "protocol.status: expected a number above 0 and at most 1 s, not 0"),
    (HEAD + 'faults = [{ kind = "lost", frame = "drive", start = 0, every = 1.5 }]\n',
     "faults[0].every: expected a whole number from 1 to 1000000000, not 1.5"),
    (HEAD + 'faults = [{ kind = "lost", frame = "drive", start = 0, probability = 2 }]\n',
     "faults[0].probability: expected a number above 0 and at most 1, not 2"),
    (HEAD + 'faults = [{ kind = "late", frame = "drive", start = 0, delay = 0 }]\n',
     "faults[0].delay: expected a number above 0 and at most 1 s, not 0"),
    (HEAD + 'faults = [{ kind = "stuck", signal = "xj", start = 2 }]\n',
     "faults[0].start: expected a time within main's 1 s, not 2"),
    (HEAD + 'faults = [{ kind = "stuck", signal = "xj", start = 0.5, end = 0.5 }]\n',
     "faults[0].end: expected after the start at 0.5 s"),
    (HEAD + 'faults = [{ kind = "lost", frame = "drive", start = 0.9999 }]\n',
     "faults[0].start: expected a fault that acts in a cycle of 0.001 s of main or more"),
    (HEAD + 'faults = [{ kind = "lost", frame = "drive", start = 0.1, end = 0.1001 }]\n',
     "faults[0].end: expected a fault that acts in a cycle of 0.001 s of main or more"),
    (HEAD + 'faults = [{ kind = "offset", signal = "xk", value = 1.0, start = 0.1 }]\n',
     "faults[0].signal: expected 'p12', 'xj' or 'xs', not 'xk'"),
    (HEAD + 'faults = [{ kind = "gone", start = 0.1 }]\n', "faults[0].kind: expected a kind: 'bus_off'"),
    (HEAD + 'faults = [\n{ kind = "parameter", parameter = "filter.clogging", value = 0.1, start = 0 },\n'
     '{ kind = "parameter", parameter = "filter.clogging", value = 0.2, start = 0.5 }]\n',
     "mine.toml:5: faults[1].start: expected a time when no other fault changes filter.clogging"),
    (HEAD + 'checks = [{ name = "c", kind = "max_error", high = 1, window = "hold_2" }]\n',
     "checks[0].window: expected a section: 'hold_1' or 'main', not 'hold_2' (did you mean 'hold_1'?)"),
    (HEAD + 'checks = [{ name = "c", kind = "max_error", high = 1, window = [0, 2] }]\n',
     "checks[0].window: expected an end within main's 1 s, not 2"),
    (HEAD + 'checks = [{ name = "c", kind = "max_error", high = 1, window = 3 }]\n',
     "checks[0].window: expected a text or [a number from 0 to 1e+06 s, a number from 0 to 1e+06 s], not 3"),
    (HEAD + 'checks = [{ name = "c", kind = "max_error", high = 1 }, { name = "c", kind = "max_error", high = 1 }]\n',
     "checks[0].name: expected a name used once, not 2 times 'c'"),
    (HEAD + 'checks = [{ name = "c", kind = "response_within", after = "x", event = "EMCY", high = 1 }]\n',
     "checks[0].after: expected a time within main's 1 s, not 'x'"),
    (HEAD + 'ends = "never"\n', "mine.toml:3: ends: expected 'completed' or 'safe_state', not 'never'"),
    (HEAD + "[model]\noverrides = { spool.mas = 1 }\n",
     "mine.toml:4: model.overrides.spool.mas: expected a field of spool"),
    (HEAD + '[model]\n[model.overrides]\nspool.mass = -1\n',
     "mine.toml:5: model.overrides.spool.mass: expected a number"),
    (HEAD + '[model]\noverrides = 3\n',
     "model.overrides: expected a table of names, each with a number or a text, not 3"),
    (HEAD + f'ends = {"9" * 5000}\n', "mine.toml: expected TOML with whole numbers of at most 4300 digits"),
    (HEAD + f'ends = 0x{"f" * 5000}\n', "mine.toml:3: ends: expected 'completed' or 'safe_state', not a huge value"),
    (HEAD + f"[model]\noverrides = {{ {'a.' * 3000}b = 1 }}\n", "levels of brackets or parts of a key"),
]


CHECKS = [  # keys of a check, the key that cannot be used, and what was expected there
    ('kind = "max_error"', "", "a low, a high, or both"),
    ('kind = "max_error", low = 2.0, high = 1.0', ".high", "a number from low = 2 up, not 1"),
    ('kind = "max_error", high = 1, band = 2', ".band", "a key: 'high'"),
    ('kind = "max_error", high = 1, unit = "bar"', ".unit", "'cm', 'inch', 'm', 'mil', 'mm', 'nm' or 'um', not 'bar'"),
    ('kind = "never_exceeds", high = 1, signal = "p12", unit = "mm"', ".unit", "'GPa', 'MPa', 'Pa'"),
    ('kind = "max_error", high = 1, window = [2.0, 1.0]', ".window", "[t0, t1] with t0 < t1, not [2.0, 1.0]"),
    ('kind = "max_error", high = 1, window = [0.0, 1e306]', ".window", "a text or [a number from 0 to 1e+06 s, a"),
    ('kind = "max_error", high = 1, skip = -1.0', ".skip", "a number from 0 to 3600 s, not -1.0"),
    ('kind = "settling_time", high = 1, band = 0', ".band", "a number above 0 and at most 100 %, not 0"),
    ('kind = "phase_lag", high = 1, frequency = 500', ".frequency", "below half the rate of 1000 Hz, not 500"),
    ('kind = "phase_lag", high = 1, frequency = 10', ".frequency", "one that the command has in this window, not 10"),
    ('kind = "recovers", high = 1', "", "a clean-up, in which to recover"),
    ('kind = "response_within", high = 1, after = 5.0, event = "EMCY"', ".after", "a time within main's 1 s, not 5.0"),
    ('kind = "response_within", high = 1, after = 0.0, signal = "xj", above = 1, below = 2', ".signal", "a signal"),
    ('kind = "event_never", event = " "', ".event", "at least one word"),
    ('kind = "response_within", high = 1, after = -1.0, event = "EMCY"', ".after", "a text or a number from 0 to"),
    ('kind = "response_within", high = 1, after = 1.0', ".event", "either an event or a signal"),
    ('kind = "response_within", high = 1, after = 1.0, signal = "xj"', ".signal", "a signal with a level"),
    ('kind = "shut_off", high = 1, after = 1.0, status = 16', ".status", "a whole number from 0 to 15"),
    ('kind = "max_error", high = 1, requirement = ["", "R"]', ".requirement", "the id of a requirement"),
]
BAD += [(HEAD + f'checks = [{{ name = "c", {keys} }}]\n', f"mine.toml:3: checks[0]{key}: expected {expected}")
        for keys, key, expected in CHECKS]
BAD += [(HEAD + f'guards = [{{ name = "g", signal = "xj"{keys} }}]\n',
         f"mine.toml:3: guards[0]{key}: expected {expected}")
        for keys, key, expected in (("", "", "a low, a high, or both"),
                                    (", low = 1, high = 1", "", "a low, a high, or both"),
                                    (", high = 1, cycles = 0", ".cycles", "a whole number from 1, not 0"),
                                    (', high = 1, unit = "bar"', ".unit", "'cm', 'inch', 'm'"))]
BAD += [(f"{HEAD}[{table}]\n{pair}\n", f"mine.toml:4: {table}.{pair.split()[0]}: expected {expected}")
        for table, pair, expected in (
            ("timing", 'overruns = "ignore"', "'abort' or 'count', not 'ignore'"),
            ("timing", "tolerate = -1", "a whole number from 0 to 1000000, not -1"),
            ("timing", "share = 1.5", "a number from 0 to 1, not 1.5"),
            ("timing", "sync = 2e-3", "at most a cycle, 0.001 s, not 0.002"),
            ("timing", "feedback = 0.0", "a number above 0 and at most 0.1 s, not 0.0"),
            ("timing", "operational = 100.0", "a number above 0 and at most 60 s, not 100.0"),
            ("timing", "grace = -1.0", "a number from 0 to 3600 s, not -1.0"),
            ("timing", "late = 1", "a key"),
            ("firmware", "vendor = -1", "a whole number from 0 to 4294967295, not -1"))]


@pytest.mark.parametrize(("text", "message"), BAD, ids=[message[:60] for _, message in BAD])
def test_a_bad_sequence_is_refused_in_one_line(text: str, message: str) -> None:
    line = catch_refusal(parse, text)
    assert message in line and line.startswith("mine.toml")


def test_lines_of_keys() -> None:
    text = ('a = "x [ {"\nb = [\n  { c = 1 }, # ]\n  { c = [1,\n 2] },\n]\n["d e".f]\ng.h = """\n\n"""\n'
            "[[i]]\n[[i]]\nj = 2024-01-01 10:00:00\nk = 1\n")
    lines = {"b[1].c[1]": 5, "b[0].c": 3, "d e.f.g.h": 8, "i[1]": 12, "i[1].k": 14}
    assert {path: tables.find_line(text, path) for path in lines} == lines


@pytest.mark.parametrize("name", sorted(Path(entry.name).stem for entry in files("rig.sequences").iterdir()
                                        if entry.name.endswith(".toml")))
def test_a_shipped_sequence_is_whole(name: str) -> None:
    s = load_sequence(name)
    assert s.title and s.description and s.checks and s.cleanup
    assert Sequence.from_bundle(s.bundle()) == s
    assert all(line == line.rstrip() for line in s.source.splitlines())
    assert s.build_cleanup_profile(3e-3).end == 0.0


def judge_preflight(changes: dict[str, float], seed: int) -> list[CheckResult]:
    """The preflight on the model alone, without a bus."""
    s = load_sequence("preflight")
    setup, main = s.build_setup_profile().command, s.build_main_profile().command
    run = simulate(load_model("eha").replace(changes), np.concatenate((setup, main)), seed=seed)
    rows = {name: column[len(setup):] for name, column in run._asdict().items()}
    return evaluate_checks(s.checks, SimpleNamespace(**{**rows, "t": run.t[:len(main)]}), s.sections())


@pytest.mark.parametrize("seed", range(4))
def test_a_sound_plant_passes_the_preflight(seed: int) -> None:
    assert [result for result in judge_preflight({}, seed) if not result.passed] == []


@pytest.mark.parametrize(("changes", "felt"), [
    ({"filter.clogging": 0.5}, {"overshoot, 5 mm", "overshoot, 1 mm", "settling, 5 mm", "error at rest"}),
    ({"spool.static_friction": 70.0}, {"break-away, out", "break-away, in", "slip speed", "settling, 5 mm"}),
])
def test_faults_are_visible_in_the_preflight(changes: dict[str, float], felt: set[str]) -> None:
    assert felt <= {result.name for result in judge_preflight(changes, 1) if not result.passed}


@pytest.mark.parametrize(("identity", "difference"), [
    (Identity(product=2, software="1.0", vendor=9), ("", "")),
    (Identity(product=2, software="1.1"), ("software", "'1.0', but the controller has '1.1'")),
    (Identity(software="1.0"), ("product", "0x00000002, but the controller has no such object"))])
def test_timing_and_firmware_are_tables_of_the_sequence(identity: Identity, difference: tuple[str, str]) -> None:
    sequence = parse(HEAD + '[timing]\noverruns = "abort"\ntolerate = 3\nshare = 0.01\n'
                            '[firmware]\nproduct = 2\nsoftware = "1.0"\n')
    assert (sequence.timing.most_in_a_row, sequence.timing.share) == (3, 0.01)
    assert sequence.firmware.find_difference(identity) == difference


@pytest.mark.parametrize(("timing", "period"), [("", 8000), ("tolerate = 3", 8000), ("tolerate = 50", 35000)])
def test_sync_is_lost_only_after_the_longest_pause_that_the_sequence_accepts(timing: str, period: int) -> None:
    """CANopenNode says so 1.5 periods after the last SYNC."""
    policy = parse(f"{HEAD}[timing]\n{timing}\n").timing
    assert policy.choose_sync_period(1e-3) == period
    assert 1.5e-6 * period >= 1e-3 * (max(policy.most_in_a_row or 0, 10) + 1) + policy.find_limits(1e-3)[0]


BASE = {"filter.clogging": 0.0, "spool.static_friction": 5.0}


def schedule(*faults: Fault, start: int = 0, stop: int = 10_000, seed: int = 0) -> Schedule:
    return Schedule(Plan(faults=faults, start=start, stop=stop, seed=seed), BASE)


def hit_cycles(s: Schedule, frame: str, cycles: int) -> list[int]:
    return [k for k in range(cycles) if s.find_action(frame, k) != NORMAL]


def test_a_parameter_ramps_from_its_base_and_returns() -> None:
    s = schedule(Parameter(parameter="spool.static_friction", value=45.0, start=1.0, end=2.0, ramp=0.1), start=500)
    values = [s.list_parameters(k)["spool.static_friction"] for k in range(4000)]
    changes = {k: values[k] for k in range(1, 4000) if values[k] != values[k - 1]}
    assert list(changes) == [*range(1501, 1601), 2500]
    assert (changes[1501], changes[1600], changes[2500]) == (pytest.approx(5.4), 45.0, 5.0)


def test_faults_end_when_main_ends() -> None:
    clogged = Parameter(parameter="filter.clogging", value=0.5, start=1.0)
    s = schedule(clogged, Lost(frame="drive", start=1.0), stop=2000)
    assert [s.list_parameters(k)["filter.clogging"] for k in (999, 1000, 1999, 2000)] == [0.0, 0.5, 0.5, 0.0]
    assert s.find_action("drive", 1999) == Action(DROP) and s.find_action("drive", 2000) == NORMAL
    assert s.edges[:2] == ((1000, "parameter filter.clogging", True), (2000, "parameter filter.clogging", False))


def test_frames_are_lost_by_count_period_and_chance() -> None:
    three, periodic = (schedule(Lost(frame=frame, start=start, end=end, every=every, count=count))
                       for frame, start, end, every, count in (("drive", 0.01, None, 1, 3),
                                                               ("feedback", 0.0, 0.1, 20, 4)))
    assert hit_cycles(three, "drive", 30) == [10, 11, 12] and hit_cycles(three, "feedback", 30) == []
    assert three.edges == ((10, "lost drive", True), (13, "lost drive", False))
    assert hit_cycles(periodic, "feedback", 200) == [0, 20, 40, 60]
    hits, again = (hit_cycles(schedule(Lost(frame="command", start=0.0, probability=0.2), seed=3), "command", 10_000)
                   for _ in range(2))
    assert len(hits) == pytest.approx(2000, abs=150) and hits == again


ONE_OF_EACH: tuple[Fault, ...] = (
    Parameter(parameter="filter.clogging", value=0.3, start=1.0, ramp=0.5), Offset(signal="p12", value=1e5, start=0.1),
    Noise(signal="xs", value=1e-6, start=0.2, end=0.4), Stuck(signal="xj", start=0.3),
    Lost(frame="drive", start=1.0, count=3), Late(frame="feedback", start=1.0, delay=1e-3),
    Silent(node="rig", start=2.0, name="rig dies"), Duplicated(frame="sync", start=0.1, every=7),
    Corrupted(frame="feedback", start=0.1, bits=3), Short(frame="command", start=0.1, length=4, count=2),
    Jitter(size=2e-4, start=0.5), Foreign(start=0.1, cob_id=0x10, frames=20), BusOff(node="plant", start=0.1, end=0.2),
    Reset(start=0.7),
)


def test_a_plan_survives_json() -> None:
    assert {fault.kind for fault in ONE_OF_EACH} == set(faults.KINDS)
    plan = Plan(faults=ONE_OF_EACH, start=500, stop=9000, seed=7)
    assert Plan.from_json(json.loads(json.dumps(plan.to_json()))) == plan


@pytest.mark.parametrize(("data", "message"), [
    ([], "scenario: expected a table"),
    ({"stop": 1, "faults": [{"kind": "lots", "frame": "drive", "start": 0}]}, "did you mean 'lost'"),
    ({"stop": 1, "faults": [{"kind": "lost", "frame": "drvie", "start": 0}]}, "did you mean 'drive'"),
    ({"stop": 1.5}, "scenario: stop: expected a whole number, not 1.5"),
    ({"stop": 10**400}, "scenario: stop: expected a whole number"),
])
def test_a_bad_scenario_is_refused(data: object, message: str) -> None:
    assert message in catch_refusal(Plan.from_json, data)


def test_words_stand_for_their_numbers_and_what_fits_together_is_taken() -> None:
    s = parse(HEAD + """faults = [
      { kind = "parameter", parameter = "filter.law", value = "linear", start = 0.1 },
      { kind = "parameter", parameter = "spool.static_friction", value = 70, start = 0.2, ramp = 0.3 },
      { kind = "parameter", parameter = "spool.dynamic_friction", value = 30, start = 0.2, ramp = 0.3 },
      { kind = "parameter", parameter = "null_bias.current", value = 1e-4, start = 0.2 },
    ]
    [model]
    overrides = { filter.law = "pressure" }
    """)
    assert s.model.overrides == {"filter.law": "pressure"}
    model = load_model("eha").replace(s.model.overrides)
    schedule = Schedule(s.plan(0), {**model.values, "null_bias.current": 0.0})
    at = [schedule.list_parameters(k) for k in (0, 100, 999, 1000)]
    assert [values["filter.law"] for values in at] == [0.0, 1.0, 1.0, 0.0]
    assert [values["spool.static_friction"] for values in at] == [5.0, 5.0, 70.0, 5.0]


def test_a_fault_that_contradicts_the_model_of_the_run_is_refused_before_it() -> None:
    """The sequence is sound on the actuator it names; --set has made another of it."""
    s = parse(HEAD + 'faults = [{ kind = "parameter", parameter = "jack.static_friction", value = 600, start = 0 }]')
    other = load_model("eha").replace({"jack.dynamic_friction": 700.0})
    Scenario.build(load_model("eha"), s.plan(0), s.build_load_profile(), 0)
    line = catch_refusal(Scenario.build, other, s.plan(0), s.build_load_profile(), 0)
    assert "parameter jack.static_friction: expected jack.dynamic_friction at most " in line


DATA = bytes(range(8))


@pytest.mark.parametrize(("action", "data", "arrives"), [
    (NORMAL, DATA, DATA), (Action(DOUBLE), DATA, DATA), (NORMAL, b"", b""), (Action(DELAY, 1000), DATA, DATA),
    (Action(CUT, 3), DATA, DATA[:3]),
    (Action(CORRUPT, 0x01 - (1 << 63)), DATA, bytes((1, 1, 2, 3, 4, 5, 6, 0x87))),  # first byte lowest
    (Action(CORRUPT, -(1 << 63)), b"\x01\x02", b"\x01\x82"), (Action(CORRUPT, 1), b"", b""),  # within the frame
    (Action(CORRUPT, 1 << 40 | 1 << 8), b"\x01\x02", b"\x01\x01")])
def test_what_arrives_of_a_frame(action: Action, data: bytes, arrives: bytes) -> None:
    length, word = change_frame(*action, len(data), int.from_bytes(data, "little"))
    assert (word & (1 << 64) - 1).to_bytes(8, "little")[:length] == arrives


def test_actions_are_as_late_as_corrupted_and_as_short_as_asked_for() -> None:
    s = schedule(Late(frame="valve_state", start=0.0, delay=400e-6), Jitter(size=2e-4, start=0.01, end=0.5),
                 Corrupted(frame="drive", start=0.0, end=0.1, bits=3), Short(frame="feedback", start=0.0, length=3))
    assert s.find_action("valve_state", 0) == Action(DELAY, 400_000) and s.find_action("feedback", 0) == Action(CUT, 3)
    masks = [s.find_action("drive", k).argument & (1 << 64) - 1 for k in range(100)]
    assert {mask.bit_count() for mask in masks} == {3} and len(set(masks)) > 90
    codes, delays = zip(*(s.find_action("sync", k) for k in range(10, 500)), strict=True)
    assert set(codes) == {DELAY} and 0 <= min(delays) < 10_000 and 190_000 < max(delays) <= 200_000
    assert s.find_action("sync", 9) == s.find_action("sync", 500) == NORMAL


def test_the_table_of_a_frame_says_what_happens_to_each() -> None:
    """Compiled loops read tables."""
    plan = Plan(faults=(*ONE_OF_EACH, Lost(frame="feedback", start=0.15, count=1)), stop=2000, seed=3)
    s = Schedule(plan, {"filter.clogging": 0.0})
    codes = set()
    for name in ("command", "sync", "feedback", "valve_state", "drive"):
        hits = s.list_frame_hits(name).tolist()
        assert hits == [[k, *s.find_action(name, k)] for k in hit_cycles(s, name, 2100)]
        codes |= {code for _, code, _ in hits}
    assert codes == {DROP, DELAY, DOUBLE, CORRUPT, CUT}


def test_frames_of_other_nodes() -> None:
    s = schedule(Foreign(start=0.01, end=0.02, cob_id=0x10, frames=3, every=4), Foreign(start=0.013, length=0))
    assert [len(s.foreign_frames(k)) for k in range(10, 22)] == [3, 0, 0, 1, 4, 1, 1, 1, 4, 1, 1, 1]
    assert s.foreign_frames(10) == [(0x10, (10).to_bytes(8, "little"))] * 3 and s.foreign_frames(13) == [(0x7E5, b"")]


def test_a_node_that_is_bus_off_sends_and_receives_nothing() -> None:
    s = schedule(BusOff(node="plant", start=0.1, end=0.2), BusOff(node="rig", start=0.3, end=0.4))
    for name, first in (("feedback", 100), ("valve_state", 100), ("drive", 100), ("command", 300), ("sync", 300)):
        assert hit_cycles(s, name, 500) == [*range(first, first + 100)]
        assert s.find_action(name, first) == Action(DROP)
    assert s.is_bus_off("plant", 150) and not s.is_bus_off("rig", 150) and not s.is_heartbeat_alive("rig", 350)
    assert s.list_frame_hits("rig")[:, 0].tolist() == [*range(300, 400)]


@pytest.mark.parametrize(("bench", "fault", "message"), [
    ("", Foreign(start=0.0, cob_id=0x183), "cob_id: expected an identifier from 1 to 0x7FF that 'EHA controller' does "
                                           "not use; 0x183 is RPDO2"),
    ("", Foreign(start=0.0, cob_id=0x702), "cob_id: expected an identifier from 1 to 0x7FF that 'EHA controller' does "
                                           "not use; 0x702 is heartbeat of node 2"),
    ("", Foreign(start=0.0, cob_id=0x205), ""),  # which node 5 of the other bench has
    ("cia402_drive", Foreign(start=0.0, cob_id=0x205), "0x205 is RPDO1"),
    ("cia402_drive", Foreign(start=0.0, cob_id=0x183), ""), ("cia402_drive", Lost(start=0.0, frame="sync"), ""),
    ("cia402_drive", Lost(start=0.0, frame="valve_state"),
     "frame: expected a frame of 'Actuator with a CiA 402 drive': 'command', 'drive', 'feedback' or 'sync', not "
     "'valve_state'"),
    ("cia402_drive", Silent(start=0.0, node="plant"), "node: expected a node of 'Actuator with a CiA 402 drive' with a "
                                                      "heartbeat, not 'plant'"),
    ("can_ecu", Jitter(start=0.0, size=1e-4), "kind: expected a fault without SYNC"),
    ("can_ecu", Reset(start=0.0), "kind: expected a fault without NMT"),
    ("can_ecu", Silent(start=0.0, node="rig"), "node: expected a node of 'Actuator with an ECU on plain CAN' with a"),
    ("can_ecu", Lost(start=0.0, frame="drive"), ""),
])
def test_a_fault_is_refused_on_a_bench_that_cannot_have_it(bench: str, fault: Fault, message: str) -> None:
    at = load_bench(str(ROOT / "examples" / bench / "bench.toml")) if bench else load_bench()
    if not message:
        require_possible([fault], at, "x.toml")
        return
    refusal = catch_refusal(require_possible, [fault], at, "x.toml")
    assert refusal.startswith("x.toml: faults[0].") and message in refusal

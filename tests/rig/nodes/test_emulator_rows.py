"""The compiled emulator in a run between processes: the rows of the embedded bus, bit for bit, whatever the faults.

A heartbeat that stops is not among them: in lockstep between processes nobody watches heartbeats.
"""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_stations import spec
from rig_command import rig
from standing_nodes import stand_nodes

from fdi.trace.mcap_log import open_log
from rig.network.node_objects import CONTROLLER, PLANT

FIELDS = ("cycle", "phase", "com", "xj", "cor", "p12", "xs", "load", "control", "status", "flags")

HEAD = """
title = "Faults of the emulator"
setup = [{ kind = "hold", time = 0.1 }]
main = [{ name = "sine", kind = "sine", amplitude = 2e-3, frequency = 4.0, time = 0.5 }]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.1 }]
load = [{ kind = "ramp", to = 2e3, time = 0.2 }]
faults = [
"""
PLANT_FAULTS = HEAD + """
  { kind = "parameter", parameter = "filter.clogging", value = 0.3, start = 0.05, end = 0.4, ramp = 0.1 },
  { kind = "parameter", parameter = "spool.static_friction", value = 30, start = 0.1, end = 0.3 },
  { kind = "offset", signal = "xj", value = 1e-4, start = 0.05, end = 0.2, ramp = 0.05 },
  { kind = "noise", signal = "xj", value = 1e-5, start = 0.1, end = 0.3 },
  { kind = "noise", signal = "xs", value = 1e-6, start = 0.2, ramp = 0.1 },
  { kind = "stuck", signal = "p12", start = 0.2, end = 0.25 },
  { kind = "stuck", signal = "xs", start = 0.3, end = 0.32, value = 1e-4 },
]
"""
FRAMES = HEAD + """
  { kind = "lost", frame = "drive", start = 0.05, end = 0.1, every = 7 },
  { kind = "lost", frame = "feedback", start = 0.1, end = 0.12, every = 9 },
  { kind = "late", frame = "feedback", start = 0.12, end = 0.2, delay = 3e-4, probability = 0.2 },
  { kind = "late", frame = "feedback", start = 0.2, end = 0.25, delay = 2.5e-3, every = 6 },
  { kind = "late", frame = "feedback", start = 0.25, end = 0.3, delay = 1e-3, every = 6 },
  { kind = "late", frame = "drive", start = 0.3, end = 0.35, delay = 3e-4, every = 3 },
  { kind = "late", frame = "drive", start = 0.35, end = 0.4, delay = 1.5e-3, every = 9 },
  { kind = "late", frame = "valve_state", start = 0.42, end = 0.45, delay = 3e-4, every = 3 },
]
"""
REPEATED = HEAD + """
  { kind = "duplicated", frame = "feedback", start = 0.05, end = 0.1, every = 7 },
  { kind = "duplicated", frame = "valve_state", start = 0.1, end = 0.12, every = 3 },
  { kind = "duplicated", frame = "drive", start = 0.12, end = 0.15 },
  { kind = "duplicated", frame = "command", start = 0.15, end = 0.2, every = 2 },
  { kind = "duplicated", frame = "sync", start = 0.2, end = 0.3, every = 5 },
  { kind = "jitter", size = 5e-4, start = 0.3, end = 0.4 },
]
"""
CORRUPTED = HEAD + """
  { kind = "corrupted", frame = "feedback", start = 0.05, end = 0.1, bits = 2, every = 5 },
  { kind = "corrupted", frame = "valve_state", start = 0.1, count = 2 },
  { kind = "corrupted", frame = "drive", start = 0.15, end = 0.2, bits = 3, every = 4 },
  { kind = "corrupted", frame = "command", start = 0.25, count = 2 },
  { kind = "short", frame = "valve_state", start = 0.3, count = 2, length = 7 },
  { kind = "short", frame = "drive", start = 0.4, count = 2, length = 5 },
]
"""
SHORT_COMMAND = HEAD.replace("Faults of the emulator", "Short command") + """
  { kind = "short", frame = "command", start = 0.1, count = 1, length = 4 },
]
"""


def read_rows(folder: Path) -> list[tuple[str, ...]]:
    """All cycles in the log as texts, in which NaN equals NaN."""
    columns = open_log(folder / "trace.mcap").read_columns("/signals")
    return [tuple(map(str, row)) for row in zip(*(columns[name].tolist() for name in FIELDS), strict=True)]


ENDS_EARLY = ("corrupted", "short_command")  # a short frame is an EMCY, which ends main
OWN = {"plant": PLANT_FAULTS, "frames": FRAMES, "repeated": REPEATED, "corrupted": CORRUPTED,
       "short_command": SHORT_COMMAND}


@pytest.fixture(scope="module")
def bus_with_nodes() -> Iterator[str]:
    """A bus on which both nodes stay from run to run."""
    where = spec("udp_multicast")
    with stand_nodes(where, PLANT, CONTROLLER):
        yield where


@pytest.mark.parametrize("sequence", ["clogging_in_flight", "lost_frames", *OWN])
def test_the_rows_are_those_of_the_embedded_bus(bus_with_nodes: str, sequence: str, tmp_path: Path) -> None:
    """The rows of the preflight are compared in test_c_run.py."""
    require_equal_rows(bus_with_nodes, sequence, tmp_path)


@pytest.mark.parametrize("bus_kind", ["socketcan"], indirect=True)
def test_so_they_are_on_a_can_interface(bus_kind: str, tmp_path: Path) -> None:
    """With the faults that touch frames."""
    where = spec(bus_kind)
    with stand_nodes(where, PLANT, CONTROLLER):
        require_equal_rows(where, "frames", tmp_path)


def require_equal_rows(where: str, sequence: str, tmp_path: Path) -> None:
    """Run a sequence on the embedded bus and on `where`, whose nodes stand there, and compare rows and exit status."""
    name = sequence
    if sequence in OWN:
        name = str(tmp_path / "sequence.toml")
        Path(name).write_text(OWN[sequence])
    words = ("run", name, "--seed", 3, "--quiet")
    said = [rig(*words, "--bus", "embedded", "--out", tmp_path / "here").status,
            rig(*words, "--bus", where, "--plant", "external", "--controller", "external",
                "--out", tmp_path / "there").status]
    here, there = read_rows(tmp_path / "here"), read_rows(tmp_path / "there")
    assert len(here) == len(there) >= (250 if sequence in ENDS_EARLY else 700)
    assert [(a, b) for a, b in zip(here, there, strict=True) if a != b] == []
    assert said[0] == said[1]

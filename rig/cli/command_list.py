"""The commands of `rig` and their one-line helps: `rig --help` shows them without importing a command."""
from __future__ import annotations

import importlib
import keyword
from types import ModuleType

HELP_OF_COMMAND = {
    "add": "add effects to a model, fit it, and show the error before and after",
    "bench": "measure speed, real time, bus faults, long recordings, robustness, or how often rig explain is right",
    "campaign": "judge a matrix of simulated faults, or a folder of traces, on all cores or a cluster",
    "check": "dry run of a sequence: its command against travel, speed and current, checks on the predicted run",
    "compare": "compare a model with a measured trace: how large the error is, where, when and in which block",
    "conformance": "test a CANopen node against CiA 301 and its EDS: numbered tests, JUnit, HTML, JSON",
    "diff": "compare two or more runs: signals, checks, timing, model, firmware",
    "doctor": "report what this machine can do: CAN, vcan, real-time rights, viewer",
    "effects": "list the catalogue of physical effects, or show one in detail",
    "explain": "find the physical effects that a model lacks, and rank the candidates",
    "export": "write a trace in another format: .csv, .csv.gz (signals), .log, .blf, .asc, .trc (raw frames)",
    "fdi": "judge filter clogging and spool friction from a trace: levels, sizes with intervals, other deviations",
    "identify": "find the parameters of your actuator from its runs, with intervals, and what the runs do not show",
    "import": "make a trace.mcap from a recording: CSV, MF4, MAT, Parquet, CAN log; --guess writes the map it needs",
    "list": "list the names that other commands take: parameters, signals, sequences, effects, checks or models",
    "node": "run the plant emulator or the reference firmware alone on a CAN bus, opposite a rig or real hardware",
    "recover": "recover a log whose writer was killed: keep all up to the last intact chunk and rebuild the index",
    "remove": "remove an effect from a model file; with a TRACE, refit and show how the error grows",
    "report": "write one HTML file about a trace; it needs no network",
    "run": "run a test sequence on the bench: log, checks, verdict",
    "simulate": "run a model on a command and write a trace",
    "trend": "follow the fault sizes of one unit through its dated traces: growth, and time left to the limits",
    "view": "open the rerun viewer on a trace, or save its recording or a picture of it",
}


def import_command(name: str) -> ModuleType:
    """Import the module of a command: `add_arguments(parser)` and `run_command(args)`, which returns the status."""
    return importlib.import_module(f"rig.cli.commands.{name}{'_' if keyword.iskeyword(name) else ''}")

"""The commands of `rig` as data: help and options. Neither `rig --help` nor a completion imports what does the work.

The module `rig.cli.commands.NAME` does the work of a command; its function `run_command` returns the exit status.
Options that several commands share stand first.
"""

import argparse
import keyword
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from rig.run.choices import CONTROLLERS, PACES, PLANTS


class Option(NamedTuple):
    """An option or argument: its names, and its settings as argparse takes them."""

    names: tuple[str, ...]
    settings: Mapping[str, Any]


class Group(NamedTuple):
    """Options with a heading of their own in the help."""

    title: str
    options: Sequence[Option]
    description: str | None = None


def option(*names: str, **settings: Any) -> Option:
    """Declare an option or argument."""
    return Option(names, settings)


def add_options(parser: argparse._ActionsContainer, options: Sequence[Option | Group]) -> None:
    """Add options to a parser."""
    for each in options:
        if isinstance(each, Group):
            add_options(parser.add_argument_group(each.title, each.description), each.options)
        else:
            parser.add_argument(*each.names, **each.settings)


def parse_integer(text: str, least: int, most: int = 2**63 - 1) -> int:
    """Parse a whole number from `least` to `most`, as an argparse type."""
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(
            f"expected a whole number from {least}{f' to {most}' if value > most else ''}, not {text!r}")
    return value


parse_whole_number, parse_count = partial(parse_integer, least=0), partial(parse_integer, least=1)
OF_EVERY_COMMAND = (
    option("--json", action="store_true", help="print one JSON object on standard output, nothing else"),
    option("--out", metavar="PATH", help="where to write the result"),
    option("--quiet", action="store_true", help="print nothing but errors"))
ANY_TRACE = "trace.mcap, the folder of a run, or a CSV"
MEASURED_TRACE = f"{ANY_TRACE} with t and the signals of the plant (rig list signals)"
TRUST = option("--trust", action="store_true",
               help="run the code that a log, model or bench file brings along; it is listed first, with its hash")
PLANT = (
    option("--model", metavar="FILE|NAME",
           help="file of a model, plant or FMU, or a shipped model: eha (default), ehs (pump-driven servo), servo (the "
                "same, a real one), ema (electromechanical), emps (the same, a real one)"),
    option("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE",
           help="change a parameter of the model or of an effect, SI units (repeatable)"),
    option("--effects", action="append", default=[], type=Path, metavar="FILE.py",
           help="your own effects (repeatable)"),
    TRUST)
CSV_OF = (option("--model", metavar="FILE|NAME", help="whose signals a CSV has: model file, plant file or model name"),
          TRUST)
SEED = option("--seed", type=parse_whole_number, default=0, metavar="N", help="seed of the noise (default 0)")
SEED_IF_GIVEN = option("--seed", **{**SEED.settings, "default": None})  # so that one that is given is noticed
MODEL = (*PLANT, SEED)
REPEAT = option("--repeat", action="append", default=[], metavar="TRACE",
                help="another run of the same command: measures the noise floor (repeatable)")
SIGNALS = option("--signals", metavar="NAME,..", help="outputs of the plant to use, such as xj,p12,xs (default: all "
                                                    "that the trace has)")
RUNS = (REPEAT, option("--holdout", metavar="TRACE", help="a run of another command that no fit sees: reveals "
                                                          "overfitting"), SIGNALS)
FAULTS = option("--faults", metavar="FILE|NAME",
                help="faults to measure: a fault file, or a shipped list by name (default: those of the plant file, or "
                     "paper)")
BENCH = option("--bench", metavar="FILE|NAME",
               help="bench file: which controller is under test, and its frames (default: eha, the shipped one; of "
                    "another plant its own controller)")
FORCE = option("--force", action="store_true", help="replace the file of --out if there is one")
REQUIREMENTS = option("--requirements", metavar="FILE",
                      help="requirements to cover, .csv (id, text) or .reqif; an id that it lacks is refused")
JUNIT = option("--junit", metavar="FILE.xml", help="also write the results as JUnit XML, for build servers")


def offer_page(name: str, place: str = "the trace") -> Option:
    """Declare --report, which writes a page of this name."""
    return option("--report", action="store_true", help=f"write a page with pictures, {name} beside {place}, or where "
                                                        "--out FILE.html says")


LIVE_ON_TERMINAL = "terminal"  # --live without a word


class Command(NamedTuple):
    """A command: its line in `rig --help`, what becomes of its results, and its options beside those of all."""

    help: str
    result: str
    options: Sequence[Option | Group]


def find_work(name: str) -> Callable[[Any], int]:
    """Import the module of a command; give the function that does its work."""
    module = import_module(f"rig.cli.commands.{name}{'_' if keyword.iskeyword(name) else ''}")
    work: Callable[[Any], int] = module.run_command
    return work


COMMANDS = {
    "add": Command(
        "add effects to a model, fit it, and show the error before and after",
        "The model goes to --out (default: that of --model, else model.toml). Exit status 0 if the effects help.",
        (option("words", nargs="+", metavar="EFFECT|TRACE",
                help="effects to add, and the measured run to fit (default: the run that the model file was fitted "
                     "to)"),
         *RUNS, *MODEL)),
    "bench": Command(
        "measure the speed of the plant, or the cycle in real time",
        "Without an argument: the speed of the plant, compared with C.",
        (option("what", nargs="?", default="plant", choices=("plant", "realtime"),
                help="plant: speed of the plant, compared with C (default); realtime: lateness and response of the "
                     "cycle, compared with cyclictest and C"),
         option("--accuracy", action="store_true",
                help="also the error of the default step size and of others, against 0.2 us (half a minute)"),
         Group("rig bench realtime", (
             option("--bus", metavar="INTERFACE:CHANNEL",
                    help="socketcan:vcan0 or udp_multicast:GROUP (default: a UDP group of its own)"),
             option("--seconds", type=float, metavar="S",
                    help="time of measurement for each row of the table (default: 60)"),
             option("--blocks", type=parse_count, metavar="N",
                    help="alternating blocks into which this time is divided (default: 6)"))))),
    "campaign": Command(
        "judge a matrix of simulated faults, or a folder of traces, on all cores or a cluster",
        "results.parquet, summary.json and detection.svg go to the folder --out (default: campaigns/NAME).",
        (option("what", nargs="?", metavar="MATRIX.toml|FOLDER",
                help="a matrix file, a shipped matrix by name (statistics), a folder of traces, or the folder of a "
                     "campaign to resume"),
         option("--summary", action="store_true", help="run nothing; summarise the finished cases"),
         option("--scheduler", metavar="ADDRESS", help="use the workers of the Dask cluster at tcp://HOST:PORT"),
         option("--jobs", type=parse_count, metavar="N",
                help="processes on this machine (default: one per core)"),
         option("--most", type=parse_count, metavar="N", help="stop after the first N cases (a fair sample of all)"),
         option("--again", action="store_true", help="judge failed cases once more"),
         Group("the matrix", (
             option("--fault", action="append", default=[], metavar="EFFECT=SIZE,..",
                    help="cases: healthy; EFFECT=SIZE,SIZE,..; or two faults in one plant, EFFECT=SIZE/EFFECT=SIZE "
                         "(repeatable)"),
             option("--seeds", type=parse_count, metavar="N", help="runs of each size (default 20)"),
             option("--seed", type=parse_whole_number, metavar="N", help="seed of the first run (default 0)"),
             option("--tolerance", metavar="X,..",
                    help="standard deviation of the base parameters, relative (default 0.015)"),
             option("--simulator", metavar="MODULE:FUNCTION",
                    help="function that simulates a unit (rig.campaign.judge.Unit) instead of the plant model"),
             option("--signals", metavar="NAME,..", help="outputs that are measured, such as xj,p12 (default: all)"),
             option("--model", metavar="FILE|NAME", help="the healthy plant: a model or plant file, or a shipped one "
                                                         "(default eha)"),
             option("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE",
                    help="change a parameter of this plant (repeatable)"),
             FAULTS, TRUST,
             option("--work", default="fdi", metavar="MODULE:FUNCTION",
                    help="function that judges a case instead of rig fdi"))))),
    "check": Command(
        "dry run of a sequence: its command against travel, speed and current, checks on the predicted run; the frames "
        "of a bench; a plant file over its nominal test; the faults of a fault file",
        "Nothing is opened and nothing moves. --bench alone lists the frames and their share of the bus. Exit status 1 "
        "if a limit is violated; --out FILE.html has a picture.",
        (option("sequence", nargs="?", metavar="SEQUENCE",
                help="test sequence: a .toml file, or the name of a shipped one; or a plant file or fault file"),
         *MODEL, BENCH)),
    "compare": Command(
        "compare a model with a measured trace: how large the error is, where, when and in which block",
        "Exit status 0 if the residual is noise, 1 otherwise.",
        (option("trace", metavar="TRACE", help=MEASURED_TRACE), *MODEL, REPEAT, SIGNALS, offer_page("compare.html"))),
    "conformance": Command(
        "test a CANopen node against CiA 301 and its EDS: numbered tests, JUnit, HTML, JSON",
        "Exit status 1 if a test failed, 3 if none failed and some times could not be measured.",
        (option("node", nargs="?", metavar="NODE",
                help="node-ID of a node on the bus, 1 to 127; or plant, controller or c (the controller in C): our "
                     "own, started by this command; with --bench its controller (default) or plant"),
         option("--bus", default="auto", metavar="INTERFACE:CHANNEL",
                help="for example socketcan:can0 or udp_multicast; our own nodes also run on the embedded bus "
                     "(default)"),
         option("--eds", type=Path, metavar="FILE",
                help="electronic data sheet of the node (our own nodes have theirs)"),
         option("--bench", metavar="FILE|NAME", help="bench file: it has node-ID and data sheet"), TRUST,
         option("--chapter", action="append", default=[], metavar="N[.M]",
                help="only this chapter or test (repeatable)"),
         option("--write", action="store_true",
                help="also change values of manufacturer and profile objects, and set them back (always for our own "
                     "nodes)"),
         option("--tolerance", type=float, default=20.0, metavar="MS",
                help="added to each time limit, for the delay of this machine (default 20)"),
         option("--timeout", type=float, default=1.0, metavar="S", help="longest wait for an SDO response (default 1)"),
         JUNIT)),
    "diff": Command(
        "compare two or more runs: signals, checks, timing, model, firmware",
        "Exit status 0 if noise explains all differences and no check changed, 1 otherwise.",
        (option("trace", metavar="A", help=f"the reference: {ANY_TRACE}"),
         option("others", metavar="B", nargs="+", help="a run to compare with the reference (repeatable)"),
         *CSV_OF, offer_page("diff.html", "the first B"))),
    "doctor": Command(
        "report what this machine can do: CAN, vcan, real-time rights, viewer",
        "Exit status 1 if the embedded bench cannot run here.",
        (Group("listen for a bench", (
             BENCH, TRUST,
             option("--seconds", type=float, default=1.0, metavar="S", help="how long to listen (default 1)"),
             option("--bus", default="auto", metavar="INTERFACE:CHANNEL",
                    help="with --bench: where to listen, such as socketcan:can0 or udp_multicast"))),)),
    "effects": Command(
        "list the catalogue of physical effects, or show one in detail",
        "An effect of --effects, or any with --test, is also tested: exit status 1 if it fails.",
        (option("name", nargs="?", metavar="NAME", help="show this effect in detail (default: list all)"),
         option("--model", metavar="FILE|NAME", default="eha", help="list the effects of this plant (default eha)"),
         option("--effects", action="append", default=[], type=Path, metavar="FILE.py",
                help="your own effects (repeatable); one that is shown is tested as well"),
         option("--test", action="store_true",
                help="test the effect, or all of them, on the preflight command; exit status 1 for a fault"))),
    "evidence": Command(
        "pack runs with inputs, versions and requirements into one sealed folder or zip, or verify such a package",
        "The package goes to --out (default: evidence.zip). Exit status 1 of --verify if a file was changed, removed "
        "or added.",
        (option("runs", nargs="*", metavar="RUN", help="folders of runs or of a suite"),
         option("--verify", metavar="PATH", help="check every byte of a package against its manifest"),
         REQUIREMENTS,
         option("--sign", metavar="KEY", help="sign the manifest: secret key file of minisign, or name of a GPG key"),
         option("--key", metavar="KEY",
                help="with --verify: demand a signature by this key: public key file of minisign, or GPG fingerprint"),
         FORCE)),
    "explain": Command(
        "find the physical effects that a model lacks, and rank the candidates",
        "Exit status 0 if nothing is missing, 1 otherwise.",
        (option("trace", metavar="TRACE", help=MEASURED_TRACE), *RUNS, *MODEL,
         option("--write-effect", metavar="FILE.py",
                help="write the law of the residual as an effect to add; where no law holds, its shape, to edit (with "
                     "--out FILE.html a law that holds is written beside it, as FILE_law.py)"),
         offer_page("explain.html"),
         Group("sizes that the search names", (
             option("--sensitivity", action="store_true",
                    help="hide each effect at several sizes in the unit that explains the runs, explain the simulated "
                         "runs, and say from which size on it is named (an hour of computing for all effects; the "
                         "same command resumes)"),
             option("--hide", metavar="NAME,..", help="effects that --sensitivity hides (default: all)"),
             option("--workers", metavar="N|ADDRESS",
                    help="processes, or the address of a Dask scheduler, for --sensitivity (default: all cores)"))))),
    "export": Command(
        "write a trace in another format, .csv, .csv.gz (signals), .log, .blf, .asc, .trc (raw frames), or a model as "
        "an FMU",
        "The suffix of --out chooses the format of a trace.",
        (option("trace", metavar="TRACE", nargs="?", help=ANY_TRACE),
         option("--all", action="store_true", help="also export the signals of set-up and clean-up"), FORCE,
         Group("a model", (
             option("--fmu", type=Path, metavar="OUT.fmu",
                    help="write the model with its effects as a unit for co-simulation: compiled code that needs "
                         "neither Python nor this program"),
             option("--fmi", choices=("2", "3"), default="2", help="version of FMI, 2.0 (default) or 3.0"),
             *MODEL)))),
    "fdi": Command(
        "judge faults from a trace (default: clogging, spool friction): levels, sizes with intervals, other deviations",
        "Exit status 0 if all faults are acceptable, 1 otherwise. --learn-bands makes bands instead.",
        (option("trace", metavar="TRACE", nargs="?", help=MEASURED_TRACE), *MODEL, FAULTS,
         option("--bands", metavar="FILE",
                help="bands to judge by (default: the shipped ones, for the preflight command)"),
         option("--with-effects", action="store_true",
                help="search the catalogue for what else is wrong, and size the faults beside it (half a minute of "
                     "computing more, two minutes where the search is hard)"),
         option("--learn-bands", nargs="*", metavar="TRACE",
                help="make bands from healthy traces of a fleet and write them to --out FILE.toml; without traces, "
                     "from simulated units"),
         option("--command", dest="command_file", metavar="FILE",
                help="command that --learn-bands simulates: CSV with t,com (default: the main phase of preflight)"))),
    "identify": Command(
        "find the parameters of your actuator from its runs, with intervals, and what the runs do not show",
        "The model goes to --out (default: identified.toml). Exit status 0 if every free parameter is identified.",
        (option("runs", nargs="+", metavar="RUN", help=f"runs to fit, of any commands: {MEASURED_TRACE}"),
         option("--holdout", action="append", default=[], metavar="RUN",
                help="a run that no fit sees: shows whether the model holds (repeatable)"),
         option("--signals", metavar="NAME,..", help="outputs to use (default: all that a run to fit has)"),
         *MODEL)),
    "import": Command(
        "make a trace.mcap from a recording: CSV, MF4, MAT, Parquet, CAN log; --guess writes the map it needs",
        "The log goes to --out (default: FILE with .mcap in place of its suffix).",
        (option("file", metavar="FILE",
                help="a recording: .csv or other text, .mf4, .mat, .parquet, .mcap, or a CAN log: .log (candump), "
                     ".blf, .asc, .trc"),
         option("--map", metavar="MAP.toml",
                help="which column is which signal, in which unit (default: a CSV has our own columns, a CAN log the "
                     "frames of --bench)"),
         option("--guess", action="store_true",
                help="write a first map (FILE.map.toml, or --out), with its reasons"),
         option("--force", action="store_true", help="replace the trace, or the map of --guess, if there is one"),
         option("--dbc", metavar="FILE", help="with --map or --guess: DBC that decodes the raw frames (default: the "
                                              "shipped eha.dbc)"),
         BENCH, option("--model", metavar="FILE|NAME",
                       help="whose signals were recorded: model file, plant file or model name (default eha)"), TRUST)),
    "list": Command(
        "list names that other commands take: parameters, signals, sequences, effects, checks, models, benches, "
        "plants, faults",
        "Names come with unit, range and default.",
        (option("kind", metavar="KIND",
                choices=("parameters", "signals", "sequences", "effects", "checks", "models", "benches", "plants",
                         "faults"),
                help="one of: parameters, signals, sequences, effects, checks, models, benches, plants, faults"),
         option("word", nargs="?", default="", metavar="WORD", help="only names that contain this word"), *MODEL,
         FAULTS)),
    "new": Command(
        "write a first file of your own, commented: a bench from the EDS, DCF or DBC of your controller, a plant, "
        "a test sequence, an effect, a fault",
        "It goes to --out (default: NAME.toml or NAME.py). Lines that are guesses say so (# unsure).",
        (option("kind", choices=("bench", "plant", "sequence", "effect", "fault"), metavar="KIND",
                help="bench: which device is under test (docs/bench.md); plant: an actuator (docs/plants.md); "
                     "sequence: a test (docs/sequences.md); effect: physics that a model may lack (docs/effects.md); "
                     "fault: what rig fdi measures (docs/fdi.md)"),
         option("name", metavar="NAME", help="name of the file, without .toml or .py"),
         option("--eds", type=Path, metavar="FILE", help="EDS or DCF of a CANopen device"),
         option("--dbc", type=Path, metavar="FILE", help="DBC of a device on plain CAN"),
         option("--node", type=parse_count, metavar="N", help="node-ID of the CANopen device (default: the DCF's, or "
                                                              "2)"),
         option("--model", metavar="FILE|NAME", help="plant that the file is for (default: eha)"),
         FORCE)),
    "node": Command(
        "run the plant emulator or the reference firmware alone on a CAN bus, opposite a rig or real hardware",
        "It runs until Ctrl-C or SIGTERM ends it, then reports the frames that it lost.",
        (option("node", choices=("plant", "controller"),
                help="plant: the plant emulator; controller: the reference firmware of the controller"),
         option("--bus", default="auto", metavar="INTERFACE:CHANNEL",
                help="the bus to join: socketcan:can0 is a CAN interface, udp_multicast works between programs on "
                     "this machine (needed, unless EHA_RIG_BUS names a bus)"),
         BENCH,
         option("--announce", action="store_true", help=argparse.SUPPRESS),  # also with --quiet: a rig waits for it
         Group("model", MODEL, "The emulator simulates it and the firmware takes its gains from it, until a rig on "
                               "the bus loads another. The bench drives servovalves: ehs and servo are refused."))),
    "recover": Command(
        "recover a log whose writer was killed: keep all up to the last intact chunk and rebuild the index",
        "The log goes to --out (default: FILE with .recovered before its suffix).",
        (option("file", metavar="FILE", help="the trace.mcap whose writer died"), FORCE)),
    "remove": Command(
        "remove an effect from a model file; with a TRACE, refit and show how the error grows",
        "The model goes to --out (default: the file of --model, in place).",
        (option("words", nargs="+", metavar="EFFECT|TRACE",
                help="the effect, and the measured run to fit the rest to"),
         *RUNS, *MODEL)),
    "report": Command(
        "write one HTML file about a trace; it needs no network",
        "The page goes to --out (default: report.html beside the trace).",
        (option("trace", metavar="TRACE", help=ANY_TRACE), *CSV_OF)),
    "run": Command(
        "run a test sequence on the bench: log, checks, verdict",
        "Results go to the folder --out (default: a new one in runs/). Exit status 0 if no check failed.",
        (option("sequence", nargs="*", metavar="SEQUENCE",
                help="test sequence: a .toml file, or the name of a shipped one (default: preflight). Several, or a "
                     "suite file, run on all cores and end in one report (docs/suite.md)"),
         *PLANT, SEED_IF_GIVEN, BENCH,
         option("--bus", default="auto", metavar="auto|embedded|INTERFACE:CHANNEL",
                help="auto: that of EHA_RIG_BUS, else the embedded one (default); embedded: in this process; or "
                     "socketcan:can0, udp_multicast, ..."),
         option("--pace", choices=PACES,
                help="lockstep: virtual time, bit-reproducible (default); realtime: wall-clock time"),
         option("--controller", choices=CONTROLLERS,
                help="the reference firmware in Python (builtin, default) or in C (c: compiled and started here), or "
                     "your own on the bus (external; default for a --bench of your own)"),
         option("--plant", choices=PLANTS,
                help="plant of a bench with a plant node: auto uses the emulator that answers on the bus, else starts "
                     "one (default)"),
         option("--max-overruns", type=float, metavar="FRACTION",
                help="largest share of overruns in a real-time run; more make its timing invalid (default: that of "
                     "the sequence, 0.001)"),
         option("--fdi", action="store_true",
                help="also judge the faults of the actuator like rig fdi, against a nominal unit"),
         JUNIT, REQUIREMENTS,
         option("--jobs", type=parse_count, metavar="N",
                help="runs at a time of several sequences or a suite (default: all cores; 1 in real time or on a CAN "
                     "bus)"),
         option("--live", nargs="?", const=LIVE_ON_TERMINAL, metavar="rerun[:PORT|:FILE.rrd]",
                help="show the run while it runs: nodes, command and position, checks, timing; without a terminal a "
                     "line every 2 s. rerun: in the viewer's window, in an open viewer at a port of 127.0.0.1, or "
                     "into a file"),
         option("--from", dest="source", type=Path, metavar="trace.mcap",
                help="repeat the run recorded in this log"))),
    "simulate": Command(
        "run a model on a command and write a trace",
        "Plant and controller in closed loop; t and the signals of the plant go to --out (default: simulation.csv).",
        (*MODEL,
         option("--command", dest="command_file", metavar="FILE",
                help="CSV with t, the plant's command (com of the EHA) and optionally its load (default: the main "
                     "phase of preflight). Of rows at most 1 ms apart a cycle takes the latest; others are joined by "
                     "straight lines"),
         FORCE,
         option("--samples", action="store_true",
                help="write recordings to try other commands on: run.csv, its repeat run2.csv, and held.csv of "
                     "another command, into the folder --out (default: here); the recorded unit has two effects that "
                     "the nominal model lacks"),
         option("--steps", type=partial(parse_integer, least=1, most=100_000), metavar="N",
                help="steps of the plant per cycle, at most 100000 (default: one every 10 us)"))),
    "trend": Command(
        "follow the fault sizes of one unit through its dated traces: growth, and time left to the limits",
        "Exit status 0 if all faults are within MidBand at the last trace, 1 otherwise.",
        (option("folder", nargs="?", metavar="FOLDER",
                help="traces of one unit, dated by their logs, names or dates.csv; or the JSON file of an earlier "
                     "answer"),
         *MODEL, FAULTS,
         option("--axis", choices=("date", "hours", "flights"),
                help="time axis of the trend (default: the first of these that all traces have)"),
         option("--dates", metavar="FILE.csv",
                help="table file,date[,hours][,flights] (default: dates.csv in the folder)"),
         option("--again", action="store_true", help="diagnose every trace again, even if its sizes are stored"))),
    "view": Command(
        "open the rerun viewer on a trace, or save its recording or a picture of it",
        "The viewer listens on 127.0.0.1 only. --out FILE.rrd writes its recording and opens nothing; --out FILE.png "
        "also draws a picture, without a display.",
        (option("trace", metavar="TRACE", help=ANY_TRACE),
         option("others", metavar="B", nargs="*",
                help="runs to draw over it and to subtract it from, as rig diff does"),
         option("--compare", action="store_true",
                help="the trace beside the model's replay, with residual and noise floor, as rig compare does; if "
                     "--model or --set adds effects or values, before and after that"),
         Group("with --compare; --model alone says whose signals a CSV has", (*PLANT, SEED_IF_GIVEN, REPEAT, SIGNALS)),
         option("--theme", choices=("light", "dark"),
                help="show it in a web browser in this theme until Ctrl-C (the window has a setting for it)"))),
}

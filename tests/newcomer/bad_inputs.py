"""What a newcomer gets wrong: some 180 command lines and files, and what the one line of the answer has to name."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from rig_command import SHORT
from short_runs import simulate_trace

from dbc import EDS
from plant import Model

SLIP = """from typing import Annotated, NamedTuple
from plant.effects import effect
from plant.quantity import Quantity
class Slip(NamedTuple):
    size: Annotated[float, Quantity("N")] = 0.0
@effect("load", Slip, law="")
def slip(x, s, u, p):
    return x + p.slip.size * s.jack_velocity
"""
HEADER = "t,com,xj,cor\n"
ROWS = "".join(f"{k / 1000:.3f},{1e-3 * (k > 50):g},0,0\n" for k in range(200))
FILES = {
    "empty.csv": "",
    "no_rows.csv": HEADER,
    "no_com.csv": "t,xj,cor\n" + "0,0,0\n0.001,0,0\n",
    "no_cor.csv": "t,com,xj\n" + "0,0,0\n0.001,0,0\n",
    "word.csv": HEADER + "0,0,0,0\n0.001,0,zero,0\n" + ROWS[200:],
    "ragged.csv": HEADER + "0,0,0,0\n0.001,0\n",
    "backwards.csv": HEADER + "0,0,0,0\n0.002,0,0,0\n0.001,0,0,0\n0.003,0,0,0\n",
    "millimetres.csv": HEADER + "".join(f"{k / 1000:.3f},{5 * (k > 50)},{5 * (k > 60)},0\n" for k in range(200)),
    "picture.csv": "\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x00\x00",
    "broken.mcap": "not a log",
    "notes.txt": "call Bob\n",
    "broken.toml": "title = \n",
    "new_key.toml": SHORT.replace("title =", "colour = 1\ntitle ="),
    "new_kind.toml": SHORT.replace('kind = "step"', 'kind = "jump"'),
    "no_time.toml": SHORT.replace('kind = "hold", time = 0.05 },\n  { name = "step"',
                                  'kind = "hold" },\n  { name = "step"'),
    "other_window.toml": SHORT.replace('window = "step"', 'window = "leap"'),
    "word_time.toml": SHORT.replace("to = 1e-3, time = 0.2", 'to = 1e-3, time = "long"'),
    "late.toml": f'{SHORT}faults = [{{ kind = "lost", frame = "drive", start = 9.0 }}]\n',
    "biased.toml": "[null_bias]\ncurrent = 1e-4\n",
    "node2.eds": EDS[2].read_text(),
    "new_group.toml": 'name = "x"\nplant = "eha"\n[rocket]\nthrust = 1.0\n',
    "new_field.toml": 'name = "x"\nplant = "eha"\n[spool]\nstatic_fricton = 35.0\n',
    "negative.toml": 'name = "x"\nplant = "eha"\n[spool]\nstatic_friction = -3.0\n',
    "word_value.toml": 'name = "x"\nplant = "eha"\n[spool]\nstatic_friction = "high"\n',
    "unit.toml": 'name = "x"\nplant = "eha"\n[spool]\nstatic_friction = 6.0\n',
    "no_colon.py": "def drag(x, s, u, p)\n    return x\n",
    "no_effect.py": "x = 1\n",
    "map.toml": '[time]\nsource = "t"\nunit = "s"\n' + "".join(
        f'[signals.{name}]\nsource = "{source}"\nunit = "{unit}"\n'
        for name, source, unit in (("com", "Sollweg", "mm"), ("xj", "xj", "m"), ("cor", "cor", "A"))),
    "no_case.toml": "", "matrix.toml": '[[case]]\nfault = "gremlin"\nsizes = [1.0]\n',
    "slip.py": SLIP, "raises.py": "1 / 0", "nocom.csv": "t,x\n0,1\n", "nan.csv": "t,com\n0,1\n0.001,nan\n",
    "binary.toml": "\xff\xfe\0",
    "bad.log": "hello\n", "bad.blf": "hello\n", "silent.log": "(0.000000) can0 702#05\n",
    "bad.dbc": "BO_ nonsense", "other.dbc": 'VERSION ""\n', "short.toml": SHORT,
    "suite.toml": 'title = "s"\n[[case]]\nsequence = "short.toml"\n',
    "bad.json": "{}",
    "nan.json": '{"axis": "date", "points": [{"trace": "a.csv", "t": NaN, "fss": SIZE, "kintas": SIZE}]}'.replace(
        "SIZE", '{"value": 1, "low": 0, "high": 2}'),
    "dates/dates.csv": "file,date\nrun.csv,yesterday\n",
}


class BadInput(NamedTuple):
    """A command line, and words that its one line of error has to hold."""

    words: str
    named: tuple[str, ...]


def bad(words: str, *named: str) -> BadInput:
    return BadInput(words, named)


BAD_INPUTS = [
    # command lines
    bad("fly", "COMMAND", "fly", "compare"),
    bad("compare", "TRACE", "required"),
    bad("compare run.csv --repat run2.csv", "--repat"),
    bad("run --seed -1", "--seed", "whole number", "-1"),
    bad("run --seed many", "--seed", "whole number", "many"),
    bad("run --pace fast", "--pace", "fast", "lockstep"),
    bad("run --max-overruns 2", "--max-overruns", "0 to 1", "2"),
    bad("run --set filter.cloging=0.5", "filter.cloging", "field of filter", "did you mean clogging"),
    bad("run --set filter.clogging", "--set", "filter.clogging", "GROUP.FIELD=VALUE"),
    bad("run --set filter.clogging=2", "filter.clogging", "below 1", "not 2"),
    bad("run --set filter.clogging=much", "filter.clogging", "much", "number"),
    bad("run --set filter.clogging=nan", "filter.clogging", "nan"),
    bad("run --model boeing", "boeing", "eha"),
    bad("run --model absent.toml", "absent.toml", "model file", "does not exist"),
    bad("run --model binary.toml", "binary.toml", "UTF-8"),
    bad("run --bus socketcan:can9", "can9"),
    bad("run --bus carrier_pigeon:1", "carrier_pigeon"),
    bad("run --out notes.txt", "notes.txt", "folder"),
    bad("run --from absent.mcap", "absent.mcap", "does not exist"),
    bad("run --requirements absent.csv", "absent.csv", "No such file"),
    bad("run --requirements notes.txt", "notes.txt", ".csv or .reqif"),
    bad("evidence absent", "absent", "folder of a run"),
    bad("evidence --verify notes.txt", "notes.txt", "folder or zip"),
    bad("list gremlins", "gremlins", "parameters"),
    bad("doctor now", "now"),
    bad("node pilot", "pilot", "plant"),
    bad("bench warp", "warp", "realtime"),
    bad("bench realtime --bus virtual:x", "--bus: virtual:x: expected socketcan:INTERFACE"),
    bad("bench realtime --blocks 0", "--blocks"),
    bad("bench realtime --seconds 0.1", "--seconds"),
    bad("bench realtime --seconds nan", "--seconds"),
    bad("bench --seconds -3", "rig bench: --seconds: expected rig bench realtime"),
    bad("conformance controller --bus virtual --eds absent.eds", "absent.eds", "No such file"),
    bad("conformance 200 --bus virtual", "200", "127"),
    bad("conformance 128", "NODE: 128: expected a node-ID from 1 to 127, controller, plant or c"),
    bad("conformance firmware", "NODE: firmware: expected a node-ID"),
    bad("conformance 5", "--eds: expected the electronic data sheet of node 5"),
    bad("conformance 5 --eds node2.eds", "--bus: embedded: expected a bus that the node is on"),
    bad("conformance plant --eds absent.eds", "absent.eds: expected a file that can be read"),
    bad("conformance plant --chapter 9", "--chapter: 9: expected the number of a chapter"),
    bad("conformance plant --junit x.txt", "--junit: x.txt: expected FILE.xml"),
    bad("conformance plant --tolerance nan", "--tolerance: nan: expected a number from 0"),
    bad("conformance plant --timeout 0", "--timeout: 0: expected a number from 0.01"),
    bad("conformance plant --chapter 1 --out page.html", "--out: page.html: expected a folder"),
    bad("effects null_bais", "null_bais", "null_bias"),
    bad("simulate --out s.txt", "--out", "s.txt", ".csv"),
    bad("simulate --out run.csv", "--out", "run.csv", "--force"),
    bad("simulate --out absent/s.csv", "absent/s.csv", "No such file"),
    bad("simulate --steps 0", "--steps", "0"),
    bad("compare run.csv --out page.pdf", "--out", "page.pdf", ".html"),
    bad("compare run.csv --out absent/page.html", "absent/page.html", "No such file"),
    bad("run --fast", "rig run: unrecognized arguments: --fast (rig run --help)"),
    bad("run --set spol.static_friction=1", "did you mean spool"),
    bad("run --set controller.period=0.002", "controller.period"),
    bad("run --set spool.mass=-1", "spool.mass: expected a number"),
    bad("run --bus udp_multicast:10.0.0.1", "IPv4 multicast group"),
    bad("run --bus token-ring", "socketcan:INTERFACE"),
    bad("run --controller external", "a bus between programs"),
    bad("run --controller external --bus udp_multicast:239.0.0.9 --set controller.proportional_gain=1",
        "controller.proportional_gain"),
    bad("run --effects raises.py", "ZeroDivisionError"),
    bad("run --out notes.txt/x", "a folder that can be written"),
    bad("run --from broken.mcap", "broken.mcap"),
    bad("run --from absent.mcap --seed 3", "the log has them"),
    bad("run --from run.csv", "only logs of `rig run`"),
    bad("simulate --command absent.csv", "absent.csv"),
    bad("simulate --command nocom.csv", "t and com"),
    bad("simulate --command nan.csv", "line 3, com"),
    bad("simulate --effects slip.py --set slip.size=1", "slip.py:8: slip: "),
    bad("effects --out absent/x.json", "absent/x.json"),
    bad("doctor --seconds 0 --out absent/x.json", "absent/x.json"),
    bad("doctor --seconds=-1", "--seconds: expected between 0 and 3600 s"),
    bad("doctor --seconds nan", "--seconds: expected between 0 and 3600 s"),
    bad("node plant --bus udp_multicast --set spool.mass=-1", "spool.mass"),
    bad("node plant --bus virtual", "a bus between programs"),
    bad("campaign no_case.toml", "no_case.toml: case: expected at least one [[case]]"),
    bad("campaign --fault filter_cloging=0.1", "did you mean filter_clogging?"),
    bad("fdi none/", "none: expected a readable file or the folder of a run; it does not exist"),
    bad("fdi folder.toml", "folder.toml: expected the folder of a run; it has no trace.mcap"),
    bad("export absent.mcap --out x.csv", "absent.mcap"),
    bad("import run.csv --dbc x.dbc", "a CSV of signals has no frames"),
    bad("import absent.blf --out x.mcap", "absent.blf"),
    # sequences and suites
    bad("run suite.toml --seed 1", "--seed: expected in the suite file"),
    bad("run short.toml short.toml --junit x.txt", "expected FILE.xml"),
    bad("run short.toml short.toml --pace realtime --jobs 2", "--jobs: 2: expected 1 in"),
    bad("run folder.toml", "folder.toml"),
    bad("run binary.toml", "UTF-8"),
    bad("run absent.toml", "absent.toml", "No such file"),
    bad("check", "SEQUENCE", "--bench FILE"),
    bad("new bench", "NAME"),
    bad("new bench drive", "--eds FILE", "--dbc FILE"),
    bad("new effect import", "NAME: import: expected"),
    bad("new effect spool_friction", "NAME: spool_friction: expected a name that no effect"),
    bad("new plant class", "NAME: class: expected"),
    bad('new sequence a"b', 'NAME: a"b: expected'),
    bad("new fault 1x", "NAME: 1x: expected"),
    bad("new bench drive --eds absent.eds", "absent.eds", "No such file"),
    bad("new bench drive --dbc binary.toml", "binary.toml"),
    bad("run --bench absent.toml", "absent.toml", "No such file"),
    bad("check absent.toml", "absent.toml", "No such file"),
    bad("check nothing", "expected a .toml file"),
    bad("check preflight --out x.png", "FILE.html"),
    bad("check preflight --set jack.mas=1", "did you mean mass"),
    bad("check preflight --model servo", "preflight: expected a sequence of your own: electrohydrostatic servo"),
    bad("check late.toml", "late.toml:14: faults[0].start: expected a time within main's 0.35 s, not 9"),
    bad("check new_kind.toml", "new_kind.toml", "main[1]", "jump"),
    bad("run preflite", "preflite", "preflight"),
    bad("run broken.toml", "broken.toml:1", "TOML"),
    bad("run new_key.toml", "new_key.toml", "colour"),
    bad("run new_kind.toml", "new_kind.toml", "main[1]", "jump", "step"),
    bad("run no_time.toml", "no_time.toml", "main[0]", "time"),
    bad("run other_window.toml", "other_window.toml", "checks[0]", "leap"),
    bad("run word_time.toml", "word_time.toml", "main[1]", "time", "number"),
    # models and effects
    bad("compare run.csv --model new_group.toml", "new_group.toml", "rocket"),
    bad("compare run.csv --model new_field.toml", "new_field.toml", "static_fricton", "static_friction"),
    bad("compare run.csv --model negative.toml", "negative.toml", "spool.static_friction", "from 0 to", "not -3"),
    bad("compare run.csv --model word_value.toml", "word_value.toml", "spool.static_friction", "number"),
    bad("compare run.csv --model broken.toml", "broken.toml:1", "TOML"),
    bad("compare run.csv --effects absent.py", "absent.py", "does not exist"),
    bad("compare run.csv --effects no_colon.py", "no_colon.py:1:"),
    bad("compare run.csv --effects no_effect.py", "no_effect.py", "effect"),
    # recordings
    bad("compare absent.csv", "absent.csv", "does not exist"),
    bad("compare empty.csv", "empty.csv"),
    bad("compare no_rows.csv", "no_rows.csv", "rows"),
    bad("compare no_com.csv", "no_com.csv", "com"),
    bad("compare word.csv", "word.csv", "line 3", "zero"),
    bad("compare ragged.csv", "ragged.csv", "line 3"),
    bad("compare backwards.csv", "backwards.csv", "t"),
    bad("compare millimetres.csv", "millimetres.csv", "m"),
    bad("compare picture.csv", "picture.csv"),
    bad("compare broken.mcap", "broken.mcap"),
    bad("compare notes.txt", "notes.txt", ".csv"),
    bad("compare dates", "dates", "trace.mcap"),
    bad("compare run.csv --signals xj,speed", "--signals", "speed", "xj"),
    bad("compare run.csv --signals=", "--signals", "expected some of xj,p12,xs"),
    bad("compare run.csv --set spool.fiction=1", "spool.fiction: expected a field of spool; did you mean"),
    bad("compare no_cor.csv", "no_cor.csv: line 1: cor: expected a column of this name"),
    bad("diff run.csv", "B", "required"),
    bad("diff run.csv absent.csv", "absent.csv", "does not exist"),
    bad("compare run.csv --repeat other.csv", "other.csv", "com"),
    bad("compare run.csv --repeat run.csv", "--repeat run.csv", "the same command run again"),
    bad("explain run.csv --repeat run.csv", "--repeat", "run.csv", "the same command run again"),
    bad("explain run.csv --repeat other.csv", "another command is no repeat", "% of the rows differ, by", " m at "),
    bad("explain run.csv --holdout run.csv", "--holdout", "run.csv", "a run that no fit has seen"),
    bad("explain run.csv --holdout absent.csv", "a trace that can be read"),
    bad("explain run.csv --signals xj,q", "--signals: q: expected some of xj,p12,xs"),
    bad("explain run.csv --out x.txt", "FILE.html for a page, or FILE.json"),
    bad("explain run.csv --write-effect x.txt", "FILE.py"),
    bad("explain no_cor.csv", "cor"),
    bad("explain run.csv --sensitivity --hide coil_log", "coil_lag"),
    bad("explain run.csv --sensitivity --workers 0", "1 or more processes"),
    bad("explain run.csv --hide coil_lag", "--sensitivity beside it"),
    bad("explain run.csv --workers 2", "--sensitivity beside it"),
    bad("add run.csv", "effect", "rig effects"),
    bad("add null_bais run.csv", "null_bais", "did you mean null_bias?"),
    bad("add null_bias", "TRACE", "rig add", "the measured run to fit"),
    bad("add null_bias run.csv --out model.txt", "model.txt", "FILE.toml"),
    bad("add null_bias run.csv --model biased.toml", "one that is not in the model already"),
    bad("add null_bias null_bias run.csv", "one that is not in the model already"),
    bad("add spool_overlap spool_underlap run.csv", "spool_underlap or spool_overlap in a model, not both"),
    bad("add current_noise run.csv", "this is noise of the bench"),
    bad("add command_rate_limit run.csv", "a difference between Cor and the model's firmware"),
    bad("add quantisation run.csv", "steps in the measured positions"),
    bad("add null_bias run.csv --holdout run2.csv --repeat run2.csv", "a run that no fit has seen"),
    bad("remove null_bias", "--model", "the model file to remove the effect from"),
    bad("remove null_bias --model unit.toml", "null_bias", "it has none"),
    bad("remove coil_lag --model biased.toml", "one that the model has (null_bias)"),
    bad("remove null_bias coil_lag --model biased.toml", "one effect at a time"),
    bad("identify", "RUN", "required"),
    bad("fdi", "TRACE"),
    bad("fdi no_cor.csv", "cor"),
    bad("fdi rest.csv", "moves"),
    bad("fdi run.csv --out x.txt", "x.txt"),
    bad("fdi run.csv --model ehs", "ehs"),
    bad("fdi run.csv --bands absent.toml", "absent.toml", "No such file"),
    bad("fdi run.csv --bands unit.toml", "unit.toml"),
    bad("trend absent", "absent"),
    bad("trend dates", "dates.csv", "yesterday"),
    bad("trend bad.json", "bad.json"),
    bad("trend nan.json", "nan.json"),
    bad("trend run.csv --out x.txt", "x.txt"),
    bad("trend", "FOLDER"),
    bad("campaign absent.toml", "absent.toml", "No such file"),
    bad("campaign --fault gremlin=1", "--fault", "gremlin"),
    bad("campaign --fault spool_frction=3", "an effect of the catalogue; did you mean spool_friction?"),
    bad("campaign --fault filter_clogging=1.5", "filter_clogging: expected a number"),
    bad("campaign --fault filter_clogging", "--fault: filter_clogging: expected healthy"),
    bad("campaign --fault healthy --tolerance 0.5", "tolerance: expected a number from 0 to 0.2"),
    bad("campaign --fault healthy --seeds 0", "seeds: expected a whole number from 1"),
    bad("campaign --fault healthy --model ehs", "--faults: expected a fault file: the plant ehs brings no faults"),
    bad("campaign --fault healthy --signals xs", "signals: expected one of xj,p12,xs or xj,p12 or xj, not 'xs'"),
    bad("campaign --fault healthy --jobs 0", "--jobs: expected a whole number from 1"),
    *(bad(f"campaign --fault healthy --work {work}", f"--work: {work}: expected module:function")
      for work in ("nothing:here", ".:x", "math:pi")),
    bad("campaign", "expected a matrix file, the shipped matrix statistics, a folder of traces, or --fault"),
    bad("campaign matrix.toml", "matrix.toml", "fault", "rig effects"),
    bad("import absent.dat", "absent.dat", "does not exist"),
    bad("import run.csv --map map.toml", "Sollweg"),
    bad("import notes.txt", "notes.txt"),
    bad("import nocom.csv", "line 1: com", "for other columns: rig import --guess nocom.csv"),
    bad("import bad.log", "bad.log", "CAN frames as .log"),
    bad("import bad.blf", "bad.blf", "CAN frames as .blf"),
    bad("import silent.log", "silent.log", "SYNC"),
    bad("import silent.log --guess --dbc bad.dbc", "bad.dbc", "expected a DBC ("),
    bad("import silent.log --dbc other.dbc", "--map or --guess with it"),
    bad("export run.csv --out x.xlsx", "x.xlsx", "ends in .csv"),
    bad("export run.csv --out x.blf", "raw frames"),
    bad("export run.csv --out run.pdf", "run.pdf", ".csv"),
    bad("view absent.mcap", "absent.mcap", "does not exist"),
    bad("view run.csv --out x.mcap", "--out: x.mcap: expected FILE.rrd or FILE.png"),
    bad("view run.csv other.csv --compare", "--compare: other.csv: expected one trace; rig view A B holds traces"),
    bad("view run.csv --theme light --out x.rrd", "--theme: light: expected no --out with it: it opens no browser"),
    *(bad(f"view run.csv {option}", f"{option.split()[0]}: expected --compare with it") for option in (
        "--set null_bias.current=1.5e-4", "--repeat other.csv", "--signals xj", "--seed 0")),
    bad("report absent.mcap", "absent.mcap", "does not exist"),
    bad("recover notes.txt", "notes.txt"),
]


def write_bad_files(folder: Path) -> None:
    """Write the files of these command lines into a folder; right ones are run.csv, run2.csv and other.csv."""
    (folder / "dates").mkdir()
    (folder / "folder.toml").mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="latin-1")
    for seed, (name, size) in enumerate((("run.csv", 1e-3), ("run2.csv", 1e-3), ("other.csv", -2e-3), ("rest.csv", 0.0),
                                         ("dates/run.csv", 1e-3))):
        command = size * (np.arange(400) > 50)
        simulate_trace(Model(), command, seed=seed, steps=20).write_csv(folder / name)


def find_faults(case: BadInput, status: int, out: str, err: str) -> list[str]:
    """What is wrong with the answer to bad input; empty if nothing is."""
    lines, command = err.splitlines(), case.words.split()[0]
    faults = [f"status {status}"] if status != 2 else []
    if out:
        faults.append("prints on standard output")
    if len(lines) != 1:
        faults.append(f"{len(lines)} lines of error")
    if not err.startswith(("rig: ", f"rig {command}: ")):
        faults.append("does not begin with the command")
    return faults + [f"does not name {word}" for word in case.named if word not in err]

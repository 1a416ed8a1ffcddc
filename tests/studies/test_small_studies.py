"""Studies in small: trial and its scorer, the paper's figures, the servo's law, fault sizes, bus faults, peers."""

import csv
import gzip
import json
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from noisy_traces import SHORT, record_plant
from physics_cases import PREFLIGHT
from places import SHARED
from short_runs import simulate_trace

from fdi.diagnosis.diagnosis import Diagnosis, diagnose
from fdi.diagnosis.faults import FRICTION, Level
from fdi.estimation import complete_model
from fdi.report import render_html
from fdi.trace import Trace
from plant import Lanes, Model
from plant.effects import CATALOGUE
from rig.bench import benchmarks
from studies import fault_size_methods as methods, paper_figures as figures
from studies.bench_mutations import run_trials
from studies.bus_faults import FAULTS, PHASES, build_bus_faults_report, collect_figures, study_bus_faults
from studies.hidden_effects import command, hidden, score
from studies.hidden_effects.truth import SYMBOLS, has_compiler, nominal_symbols, parameter_names, simulate_truth
from studies.long_recordings import make_command, record_unit
from studies.peers import grid_runs, many_runs, rivals
from studies.robustness import run_study as robustness
from studies.robustness.disturb import disturb_run, find_processes, judge_verdict
from studies.servo_ledger import fit_directional_gains


def test_recordings_repeat_by_their_seed() -> None:
    """A recording is as long as asked for, holds what a bench measures, and is the same for the same seed."""
    com = make_command(15.0, 3)
    assert len(com) == 15_000
    once, again = (record_unit(com[:2000], 3) for _ in range(2))
    assert once.signals == ("com", "xj", "cor", "p12", "xs", "load")
    assert (once.xs == again.xs).all()
    assert (record_unit(com[:2000], 4).xs != once.xs).any()


@cache
def trace(kintas: float, fss: float) -> Trace:
    model = Model().replace({"filter.clogging": kintas, "spool.static_friction": fss,
                             "spool.dynamic_friction": fss / 1.5})
    return simulate_trace(model, PREFLIGHT)


def texts(svg: str) -> set[str]:
    """What is written in a drawing; it must be one."""
    root = ElementTree.fromstring(svg)
    assert root.tag.endswith("svg")
    return {element.text or "" for element in root.iter() if element.tag.endswith("text")}


def test_either_fault_alone() -> None:
    runs = {"healthy": trace(0.0, 5.0), "Kintas 0.35": trace(0.35, 5.0), "FSS 70 N": trace(0.0, 70.0)}
    for draw in (figures.draw_steps, figures.draw_ramps):
        assert set(runs) <= texts(draw(runs))
    assert "error [um]" in texts(figures.draw_ramps(runs, number=1))


DATA = SHARED / "data" / "electrohydrostatic_rig_raw"


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no measurements at {DATA.name}: they belong to others")
def test_the_servos_firmware() -> None:
    """10 out and 7 back, without delay, and nearly without anything left."""
    columns = np.loadtxt(DATA / "exp_data_2_2.csv.gz", delimiter=";", skiprows=61, usecols=(9, 13, 14, 16))
    answer, demand, position, valve = columns.T
    law = fit_directional_gains(demand - position, answer, valve)
    assert (law.out, law.back) == pytest.approx((10.0, 7.0), abs=0.05)
    assert law.delay == 0 and law.residual < 0.01 * law.answer


@pytest.fixture(scope="module")
def other_command() -> Diagnosis:
    return diagnose(record_plant({"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0}, SHORT))


@pytest.mark.parametrize("name", [
    "differential evolution", "simulated annealing",
    pytest.param("genetic", marks=pytest.mark.skipif(not methods.is_installed("pygad"), reason="needs pygad"))])
def test_global_optimisers_leave_less_than_the_grid(name: str, other_command: Diagnosis) -> None:
    d, grid = other_command, (0.1, 38.0)
    at_grid = methods.Objective(methods.make_problem(d.model, d.trace, d.floor), d.model, grid)
    grid_residual = at_grid.report("grid", at_grid.start).left
    row = methods.METHODS[name](d.model, d.trace, grid, d.floor, 0)
    assert row.left < 0.9 * grid_residual and 200 < row.simulations < 500
    assert 19.0 <= row.fss <= 76.0 and 0.0 <= row.kintas <= 0.3


@pytest.mark.skipif(not methods.is_installed("sklearn"), reason="needs scikit-learn")
def test_learners_know_units_that_they_never_saw(other_command: Diagnosis) -> None:
    data = methods.simulate_lesson(other_command.trace, other_command.model, cloggings=(0.0, 0.3),
                                       frictions=(5.0, 45.0, 90.0), held_out=4)
    assert data.unseen.sum() == 2 * 3 * 4
    for learner in methods.LEARNERS.values():
        row = learner(data)
        assert row.right[FRICTION.name] > 0.9 and row.levels[FRICTION.name] == Level.MAINTENANCE.word


LOST, TOLERATED = FAULTS[0], FAULTS[5]


def test_the_figures_of_two_faults() -> None:
    cells = study_bus_faults(1, (LOST, TOLERATED))
    assert [cell.phase for cell in cells] == [*PHASES] * 2 and all(cell.passed for cell in cells)
    for cell in cells[:4]:
        times = (cell.activation_ms, cell.detection_ms, cell.reaction_ms, cell.recovery_ms)
        assert times == pytest.approx((0, 3, 3, 1))
        assert "0x8250" in cell.detected_by
    for cell in cells[4:]:  # the plant flags the missing frame at the next SYNC
        assert cell.activation_ms == pytest.approx(1) and cell.detection_ms is None and cell.reaction_ms is None
    report = build_bus_faults_report(cells, 1)
    assert report.data == collect_figures(cells, 1) and report.data["verdict"] == "PASS"
    page = render_html(report)
    assert LOST.name in page and "tolerated" in page and "Activation" in page


def test_damaged_files_are_refused_in_one_line_or_make_a_bench() -> None:
    kinds: Counter[str] = Counter()
    for number, _, outcome in run_trials(150, 2):
        assert outcome.kind != "failed", f"trial {number}: {outcome.text}"
        kinds[outcome.kind] += 1
    assert min(kinds["loaded"], kinds["refused"]) > 10


needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason=f"no gcc; {benchmarks.GET_GCC}")


def list_sound_rivals(compare: Callable[..., Sequence[rivals.Rival]], **options: Any) -> dict[str, rivals.Rival]:
    """The rivals by name; those that are not installed say so, the others make the same numbers."""
    stages: list[str] = []
    rivals_by_name = {rival.name: rival for rival in compare(
        PREFLIGHT[:1500], lambda stage, share: stages.append(stage), rounds=2, **options)}
    assert len(rivals_by_name) == 8 and stages
    for name, rival in rivals_by_name.items():
        if rival.speed is None:
            assert name.startswith(("jax", "ProgPy")) and "is not installed" in rival.note
        elif name != grid_runs.REFERENCE:
            assert rival.ratio > 0.0 and rival.difference < 1e-12
    return rivals_by_name


@needs_gcc
def test_every_rival_makes_the_same_runs() -> None:
    """Those of the `bench` extra where it is installed; without fused multiply-add C even to the last bit."""
    rivals_by_name = list_sound_rivals(many_runs.compare_many_runs, cycles=300)
    for name in (many_runs.OURS, "ours, a thread a core", "C, 16 runs, -ffp-contract=off"):
        assert rivals_by_name[name].difference == 0.0


@needs_gcc
def test_every_rival_makes_the_same_map() -> None:
    reference = list_sound_rivals(grid_runs.compare_grid_runs)[grid_runs.REFERENCE]
    assert reference.ratio > 0.0 and 1e-6 < reference.difference < 3e-3


LIMIT = 600.0  # s: it only ends a test that hangs


def test_a_killed_process() -> None:
    """The plant, soon after the first cycles."""
    trial = disturb_run("kill", "plant", 13, limit=LIMIT)
    assert trial.problems == () and trial.cycles > 0, trial


GONE = "ABORTED node 3 plant stopped answering: no feedback frame since cycle 9; "


@pytest.mark.parametrize(("action", "victim", "pause", "status", "message", "is_sound"), [
    ("kill", "plant", 0.0, 1, f"{GONE}its process was ended by SIGKILL", True),
    ("kill", "plant", 0.0, 1, f"{GONE}no heartbeat any more: last heartbeat 0.30 s ago", False),
    ("kill", "controller", 0.0, 1, f"{GONE}its process was ended by SIGKILL", False),  # the wrong node
    ("kill", "plant", 0.0, 0, "PASS", False),
    ("stop", "plant", 0.9, 0, "PASS", True),
    ("stop", "plant", 0.9, 1, f"{GONE}no heartbeat for 2.1 s either", False),
    ("stop", "plant", 3.1, 1, f"{GONE}no heartbeat for 2.1 s either", True),
    ("stop", "plant", 3.1, 0, "PASS", False),
    ("stop", "rig", 3.1, 0, "PASS", True),
    ("stop", "rig", 0.9, 2, "rig run: the turn to send was held for more than 10 s by process 7", False),
])
def test_what_the_verdict_of_a_disturbed_run_must_be(action: str, victim: str, pause: float, status: int, message: str,
                                                     is_sound: bool) -> None:
    assert (judge_verdict(action, victim, pause, status, message) == []) == is_sound


def test_a_log_that_cannot_be_written() -> None:
    trial = disturb_run("fill disk", "rig", 12, limit=LIMIT)
    assert trial.problems == () and trial.status == 2 and "log" in trial.message, trial


def test_the_study_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fuzz frames into both nodes and the rig, datagrams on the bus, changed logs, and short runs one after the other.

    Some of the changed logs are still good enough to be read; the others are refused, and nothing else happens.
    """
    monkeypatch.setattr(robustness, "SEQUENCE", robustness.SEQUENCE.replace("time = 3.0", "time = 0.3"))
    figures = robustness.run_study(2000, 0, 0.01, 1, "builtin", lambda stage, share: None)
    assert figures["problems"] == [] and figures["soak"]["verdicts"] == {"PASS": figures["soak"]["runs"]}
    assert [count["works"] and count["frames"] >= 2000 for count in figures["frames"]] == [True] * 3
    assert min(count["answers"] for count in figures["frames"][:2]) > 40
    assert max(figures["datagrams"]["growth"].values()) < 16 << 20
    logs = figures["logs"]
    assert logs["accepted"]["recover"] > 0 and logs["accepted"]["report"] + logs["refused"]["report"] == 2
    report = robustness.build_robustness_report(figures)
    assert report.verdict == "PASS" and len(report.sections) == 4
    assert not find_processes("239.1.1.1")
    assert robustness.build_robustness_report({**figures, "problems": ["it hung"]}).verdict == "FAIL"


PRACTICE = SHARED / "practice"
EXACT: dict[str, dict[str, float]] = {
    "01": {"Kintas": 0.3}, "02": {"bias": 0.03 * 8e-3}, "06": {"aero": 5.4e5},
    "09": {"cog": 2750.0, "cog_l": 2.5e-3}, "10": {"FSS": 33.0, "FDS": 22.0, "Kintas": 0.21},
}
needs_simulator = pytest.mark.skipif(not has_compiler(), reason="no gcc: the trial's simulator cannot be built")
shared = pytest.mark.skipif(not PRACTICE.exists(), reason="no ../shared: no traces of an independent simulator")


def rms(x: np.ndarray) -> float:
    return float(np.sqrt((x**2).mean()))


def read(path: Path) -> dict[str, np.ndarray]:
    with gzip.open(path, "rt") as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, dtype=float).T, strict=True))


@needs_simulator
@shared
@pytest.mark.parametrize(("case", "name"), [*((case, "est") for case in EXACT), ("09", "holdout")])
def test_the_simulator_leaves_sensor_noise_of_an_independent_trace(case: str, name: str) -> None:
    trace = read(PRACTICE / case / f"{name}.csv.gz")
    run = simulate_truth(trace["com"], EXACT[case], load=trace["load"], cor=trace["cor"])
    assert rms(run.xj - trace["xj"]) == pytest.approx(2e-6, rel=0.05)
    assert rms(run.p12 - trace["p12"]) == pytest.approx(2e4, rel=0.03)
    assert rms(run.xs - trace["xs"]) == pytest.approx(1e-6, rel=0.03)


@needs_simulator
def test_every_effect_of_the_catalogue_is_hidden_in_some_case() -> None:
    assert set(hidden.CATALOGUE) == {name for name, effect in CATALOGUE.items() if not effect.disturbance}
    assert len(hidden.OUTSIDE) >= 8 and not set(hidden.OUTSIDE) & set(CATALOGUE)


def plants(effect: hidden.Hidden) -> dict[str, float]:
    """The plant's names for what is hidden."""
    entry, changes = CATALOGUE[effect.name], effect.changes
    if entry.base:
        return {SYMBOLS[symbol]: value for symbol, value in changes.items() if symbol in SYMBOLS}
    more = {"stribeck": {"stribeck.speed": changes.get("stribeck_v", 0.0)},
            "supply_ripple": {"supply_ripple.frequency": changes.get("ripple_hz", 0.0)},
            "structural_resonance": {"structural_resonance.frequency": 35.0,
                                     "structural_resonance.damping_ratio": 0.02}}
    return {entry.fitted[0]: effect.value} | more.get(effect.name, {})


@needs_simulator
def test_the_plants_effects_are_what_the_table_says_as_written_twice() -> None:
    """Both replay the same current with the same size hidden; what is left is far below the sensors' noise."""
    com = np.concatenate([command.preflight_command()[500:1700], command.preflight_command()[11_000:13_000]])
    load = command.known_load_profile(len(com), 6000.0)
    drive = simulate_truth(com, {}, load=load).cor
    # of a signed effect one seed gives the sign -, one +
    effects = [hidden.sample_hidden_effect(name, nominal_symbols(), np.random.default_rng(seed), 0.7, 0.7)
               for seed in (1, 2) for name, law in hidden.CATALOGUE.items() if seed == 1 or law.signed]
    effects = [effect for effect in effects if effect.name != "command_rate_limit"]  # not in the plant
    model = complete_model(Model())  # the kernels of `rig explain`
    names = sorted({name for effect in effects for name in plants(effect)})
    rows = [[plants(effect).get(name, model[name]) for name in names] for effect in effects]
    outputs = Lanes(model, names, 100).replay(np.array(rows), drive, load)
    for effect, run in zip(effects, outputs, strict=True):
        symbols = set(parameter_names()) - {"bristle_v"}
        changes = {key: value for key, value in effect.changes.items() if key in symbols}
        truth = simulate_truth(com, changes, load=load, cor=drive)
        columns = zip(run.T, (truth.xj, truth.p12, truth.xs), (2e-6, 2e4, 1e-6), strict=True)
        errors = [rms(x - y) / floor for x, y, floor in columns]
        assert max(errors) < (1.0 if effect.name == "compressibility" else 0.5), (effect.name, effect.size, errors)


def truth(kind: str, effects: Sequence[str] = (), floors: float = 9.0, where: Sequence[str] = ("xj/s02", "xs/s03"),
          **more: Any) -> dict[str, Any]:
    """A truth as the maker writes it."""
    each = [{"name": name, "size": 1.0, "value": 20.0, "floors": {"xj": floors, "cor": 0.0}} for name in effects]
    return {"kind": kind, "signals": "xj,p12,xs", "effects": each, "floors": {"xj": floors},
            "where": list(where) if effects else [], "holdout_noise": {"xj": 2e-6}} | more


def answer(verdict: str, *effects: str, **more: Any) -> dict[str, Any]:
    return {"verdict": verdict, "effects": list(effects)} | more


SPOOL_FRICTION = "spool_friction"
PAIRS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "00000": (truth("nothing", floors=0.0), answer("nothing", seconds=30.0)),
    "00001": (truth("nothing", floors=0.0), answer("explained", "coil_lag", seconds=5.0, where=["xj/s03"])),
    "00002": (truth("one", [SPOOL_FRICTION]), answer("explained", SPOOL_FRICTION, holdout={"xj": 2.2e-6},
                                               where=["xj/s02", "xj/s04"],
                                               sizes={SPOOL_FRICTION: {"value": 20, "low": 19, "high": 21}})),
    "00003": (truth("one", [SPOOL_FRICTION]), answer("ambiguous", "coil_lag", SPOOL_FRICTION, holdout={"xj": 4e-6},
                                               sizes={SPOOL_FRICTION: {"value": 21, "low": 20.5, "high": 22}})),
    "00004": (truth("one", [SPOOL_FRICTION]), answer("explained", "coil_lag", where=["xj/s02"])),
    "00005": (truth("one", [SPOOL_FRICTION], floors=1.5), answer("nothing")),
    "00006": (truth("outside", ["periodic torque"]), answer("unexplained")),
    "00007": (truth("outside", ["periodic torque"], floors=1.0), answer("explained", "null_bias")),
    "00008": (truth("two", ["null_bias", "coil_lag"]), answer("explained", "coil_lag", "null_bias")),
    "00009": (truth("two", ["null_bias", "coil_lag"]), answer("partly", "null_bias")),
    "00010": (truth("one", [SPOOL_FRICTION]), answer("ambiguous", "a", "b", "c", SPOOL_FRICTION)),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A benchmark of invented cases, with invented answers."""
    (tmp_path / "truth").mkdir()
    for case, (truth, _) in PAIRS.items():
        (tmp_path / "truth" / f"{case}.json").write_text(json.dumps(truth))
    (tmp_path / "answers.json").write_text(json.dumps({
        "answers": {case: answer for case, (_, answer) in PAIRS.items()}}))
    return tmp_path


def run_script(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The scorer as others run it: without site packages and without this project on the path."""
    return subprocess.run([sys.executable, "-I", "-S", str(score.__file__), *map(str, arguments)], capture_output=True,
                          text=True, check=False)


@needs_simulator
def test_rates_count_what_they_say(folder: Path) -> None:
    scores = json.loads(run_script(folder, folder / "answers.json", "--json").stdout)
    rates = {rate["name"]: (rate["good"], rate["of"], rate["without"]) for rate in scores["rates"]}
    assert rates == {
        "nothing: answered nothing": (1, 2, ["00001"]),
        "nothing: an effect is named": (1, 2, ["00000"]),
        "one: named": (2, 4, ["00004", "00010"]),
        "one: named alone, explained": (1, 4, ["00003", "00004", "00010"]),
        "one: wrong alone": (1, 4, ["00002", "00003", "00010"]),
        "one, below 2 floors: named": (0, 1, ["00005"]),
        "one, below 2 floors: wrong alone": (0, 1, ["00005"]),
        "one, named: true size in interval": (1, 2, ["00003"]),
        "one, named: held-out run at most 1.15 floors": (1, 2, ["00003"]),
        "two: both named": (1, 2, ["00009"]),
        "two: wrong alone": (0, 2, ["00008", "00009"]),
        "two, named: true sizes in intervals": (0, 0, []),
        "outside: unexplained or partly": (1, 1, []),
        "outside, any size: not explained": (1, 2, ["00007"]),
        "all: answered within 20 s": (1, 2, ["00000"])}
    assert scores["names_on_average"] == 1.5 and scores["seconds"] == {"median": 30.0, "longest": 30.0}


@needs_simulator
@pytest.mark.parametrize(("text", "message"), [
    ("[", "expected a JSON file"),
    ("{}", "expected an object with one entry per case"),
    ('{"00002": {"verdict": "perhaps"}}', "case 00002: verdict: expected nothing, explained"),
    ('{"00099": {"verdict": "nothing"}}', "case 00099: case: expected one of the benchmark"),
    ('{"00002": {"verdict": "nothing", "effects": "coil_lag"}}', "case 00002: effects: expected a list"),
    ('{"00002": {"verdict": "nothing", "sizes": {"a": {"low": "x"}}}}', "sizes, holdout, seconds: expected finite"),
])
def test_bad_answers_are_refused_in_one_line(text: str, message: str, folder: Path) -> None:
    (folder / "answers.json").write_text(text)
    done = run_script(folder, folder / "answers.json")
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith(f"score.py: {folder / 'answers.json'}: ") and message in done.stderr

"""Foreign units as plants: the exported EHA gives its own rows, others run, and bad ones end in a line."""

import json
from pathlib import Path

import numpy as np
import pytest
from c_device import skip_without_compiler
from places import ROOT
from rig_command import answer, refuse, rig

from fdi.trace.trace import Trace
from plant import RigError, load_model, simulate
from plant.lanes import Lanes
from plant.tables import Place
from rig.fmi import foreign
from rig.fmi.export import export_fmu
from rig.fmi.foreign import Port, Unit, find_variable, read_description

pytest.importorskip("fmpy")
from foreign_fmu import build_fmu

SLIDE = """
name = "slide"
[plant]
file = "slide.fmu"
[plant.inputs]
current = { variable = "u", count = "1 mA" }
load_force = { variable = "F", count = "100 N" }
[plant.outputs]
ram_position = { variable = "slide.x", count = "1 mm", noise = "1 um" }
[plant.parameters]
drive.gain = { variable = "k", range = [0.5, 10] }
drive.damping = "d"
drive.is_big = "is_big"
[controller]
proportional_gain = 4.0
[drive]
gain = 2.0
damping = 8.0
"""
SHORT = """
title = "Short"
setup = [{ kind = "hold", time = 0.02 }]
main = [{ name = "rest", kind = "hold", time = 0.05 }, { name = "step", kind = "step", to = 1e-3, time = 0.2 }]
cleanup = [{ kind = "hold", time = 0.02 }]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The present folder, with a model file of a slide and a short sequence."""
    skip_without_compiler()
    monkeypatch.chdir(tmp_path)
    Path("slide.toml").write_text(SLIDE)
    Path("short.toml").write_text(SHORT)
    rows = ((t, 1e-3 * (t > 0.2) + 5e-4 * np.sin(9 * t)) for t in np.arange(0, 1.5, 0.01))
    Path("command.csv").write_text("t,com\n" + "".join(f"{t:.2f},{com:.6f}\n" for t, com in rows))
    return tmp_path


@pytest.mark.parametrize("version", [pytest.param("2", marks=pytest.mark.slow), "3"])
def test_the_exported_eha_gives_its_own_rows_again(folder: Path, version: str) -> None:
    export_fmu(load_model(), Path("eha.fmu"), version)
    own, again = load_model(), load_model("eha.fmu")
    com = 1e-3 * np.sin(np.arange(600) / 50)
    load = 800 * np.cos(np.arange(600) / 70)
    changes = {"spool.static_friction": 25.0}
    expected = simulate(own.replace(changes), com, load, seed=3)
    found = simulate(again.replace(changes), com, load, seed=3)
    assert [a.tobytes() for a in found] == [b.tobytes() for b in expected]
    values = np.array([[20.0], [40.0]])
    quiet = dict.fromkeys(("sensors.position_noise", "sensors.pressure_noise", "sensors.spool_noise"), 0.0)
    runs = [Lanes(model.replace(quiet), ["spool.static_friction"], 100).replay(
        values, expected.cor, load, expected.xj, 5.0) for model in (own, again)]
    assert (np.abs(runs[1] - runs[0]) <= 1e-12 * np.abs(runs[0]).max(axis=(0, 1))).all()
    bench = (ROOT / "rig" / "benches" / "eha.toml").read_text().replace('plant = "eha"', 'plant = "eha.fmu"')
    for eds in (ROOT / "dbc").glob("*.eds"):
        Path(eds.name).write_text(eds.read_text())
    Path("bench.toml").write_text(bench)
    words = ("run", "short.toml", "--quiet", "--set", "spool.static_friction=25")
    assert (rig(*words, "--out", "own").status, rig(*words, "--bench", "bench.toml", "--out", "fmu").status) == (0, 0)
    first, second = Trace.read("own", all=True), Trace.read("fmu", all=True)
    for name in first.signals:
        assert first.column(name).tobytes() == second.column(name).tobytes(), name


@pytest.mark.parametrize("version", ["2", "3"])
def test_a_unit_of_another_tool_is_mapped_simulated_and_compared(folder: Path, version: str) -> None:
    build_fmu(Path("slide.fmu"), version)
    answer("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")
    trace = Trace.read("run.csv", signals=load_model("slide.toml").kind.signals)
    x = v = 0.0
    clean = []
    for current, force in zip([0.0, *trace.cor[:-1]], trace.load, strict=True):
        clean.append(x)
        v += 1e-3 * (2.0 * (current / 1e-3) - force / 100.0 - 8.0 * v)
        x += 1e-3 * v * 1e3 * 1e-3
    np.testing.assert_allclose(trace.xj, clean, atol=6e-6)  # the sensor's noise
    assert np.std(trace.xj - clean) == pytest.approx(1e-6, rel=0.1)
    assert answer("compare", "run.csv", "--model", "slide.toml")["verdict"] == "WITHIN_FLOOR"
    other = answer("compare", "run.csv", "--model", "slide.toml", "--set", "drive.gain=2.2", status=1)
    assert other["verdict"] == "MODEL_INCOMPLETE"
    assert "a plant with equations" in refuse("explain", "run.csv", "--model", "slide.toml")
    assert "from 0.5 to 10" in refuse("simulate", "--model", "slide.toml", "--set", "drive.gain=12")


def test_identify_finds_the_parameters_that_the_map_gives_a_range(folder: Path) -> None:
    build_fmu(Path("slide.fmu"))
    answer("simulate", "--model", "slide.toml", "--command", "command.csv", "--set", "drive.gain=2.4", "--out",
           "run.csv")
    found = answer("identify", "run.csv", "--model", "slide.toml", "--out", "found.toml")
    assert found["parameters"]["drive.gain"]["value"] == pytest.approx(2.4, rel=0.01)


BROKEN = {
    "crash": ({"does": "CRASH", "at": 100}, "the unit crashed in step (SIGSEGV); its last message: about to fail"),
    "hang": ({"does": "HANG", "at": 100}, "the unit has not answered for 4 s in step; it was stopped"),
    "refusal": ({"does": "REFUSE", "at": 100}, "at 0.1 s; its message: the solver did not converge"),
    "NaN": ({"does": "GIVE_NAN", "at": 100}, "the unit gives nan for xj at 0.101 s"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_unit_that_breaks_ends_the_run_with_a_verdict_and_a_readable_log(
    folder: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault, expected = BROKEN[name]
    build_fmu(Path("slide.fmu"), **fault)  # type: ignore[arg-type]
    monkeypatch.setattr(foreign, "LONGEST_CALL", 4.0)  # loading takes a second on a busy machine
    assert expected in refuse("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")
    said = rig("run", "short.toml", "--model", "slide.toml", "--out", "run", "--quiet")
    assert said.status == 1, said
    verdict = json.loads(Path("run", "verdict.json").read_text())
    assert verdict["verdict"] == "ABORTED" and expected in json.dumps(verdict)
    assert len(Trace.read("run", all=True)) > 50


REFUSED = {
    "another platform": ({"platform": "win64"}, "slide.so; it has only binaries/win64/slide.so"),
    "source code": ({"sources": True}, "it has none and source code: python -m fmpy compile slide.fmu"),
    "version": ({"fmi": "1.0"}, "fmiVersion: expected 2.0 or 3.0, not 1.0"),
    "model exchange": ({"kind": "ModelExchange"}, "an FMU for co-simulation; this one is for model exchange only"),
    "its tool": ({"unit": 'needsExecutionTool="true"', "does": "REFUSE", "at": 1}, "needs the tool that made it"),
    "step": ({"unit": 'fixedInternalStepSize="0.0003"'}, "a step of which the cycle of 1 ms is a multiple, not 0.3 ms"),
    "event mode": ({"does": "EVENT_MODE"}, "its message: this unit needs event mode"),
    "end": ({"does": "END", "at": 3}, "the unit asks to end the simulation"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_unit_that_cannot_run_here_is_refused(folder: Path, name: str) -> None:
    build_fmu(Path("slide.fmu"), **REFUSED[name][0])  # type: ignore[arg-type]
    assert REFUSED[name][1] in refuse(
        "simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")


MAPS = {  # replaced in SLIDE
    "no file": ('file = "slide.fmu"', 'file = "none.fmu"', "none.fmu: expected an FMU; it does not exist"),
    "no zip": ('file = "slide.fmu"', 'file = "slide.toml"', "an FMU, a zip archive with a modelDescription.xml"),
    "no variable": ('"slide.x"', '"slide.y"', "a variable of slide.fmu, not 'slide.y'; did you mean slide.x?"),
    "wrong way": ('variable = "u"', 'variable = "slide.x"', "a variable that is input; slide.x is output"),
    "unit": ('count = "1 mm"', 'count = "1 bar"', "not 'bar'"),
    "noise": ('noise = "1 um"', 'noise = "1 bar"', "plant.outputs.ram_position.noise: expected one of m,"),
    "key": ("[plant.inputs]", "[plant.input]", "plant.input: expected one of file, seed, inputs, outputs, parameters"),
    "two drives": ('load_force = {', 'torque = {', "one signal that drives the plant"),
    "no dot": ('drive.damping = "d"', 'damping = "d"', "GROUP.NAME = VARIABLE"),
}


@pytest.mark.parametrize("name", MAPS)
def test_a_wrong_map_is_refused_with_its_line(folder: Path, name: str) -> None:
    build_fmu(Path("slide.fmu"))
    old, new, expected = MAPS[name]
    Path("slide.toml").write_text(SLIDE.replace(old, new))
    assert expected in refuse("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")


@pytest.mark.parametrize("version", ["2", "3"])
def test_a_unit_may_lack_functions_that_nobody_calls_and_may_exist_once(folder: Path, version: str) -> None:
    """FMPy looks for all functions of the interface; a unit that may exist once is reset between runs."""
    build_fmu(Path("slide.fmu"), version, unit='canBeInstantiatedOnlyOncePerProcess="true"', stubs=False)
    answer("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")
    assert answer("compare", "run.csv", "--model", "slide.toml")["verdict"] == "WITHIN_FLOOR"


def test_a_drive_of_its_own_has_no_limit_of_the_shipped_actuator(folder: Path) -> None:
    build_fmu(Path("slide.fmu"))
    Path("own.toml").write_text(SLIDE.replace("current =", "torque =").replace("1 mA", "1 N m"))
    assert load_model("own.toml")["controller.current_limit"] > 1e6


def test_a_run_has_the_period_of_the_model_file(folder: Path) -> None:
    build_fmu(Path("slide.fmu"))
    own = SLIDE.replace("current =", "torque =").replace("1 mA", "1 N m").replace("ram_position", "angle")
    Path("own.toml").write_text(own.replace("[controller]", "[controller]\nperiod = 2e-3"))
    assert rig("run", "short.toml", "--model", "own.toml", "--out", "run").status == 0


def test_without_a_map_the_answer_lists_the_variables(folder: Path) -> None:
    build_fmu(Path("slide.fmu"))
    assert "the unit has input u, input F, output slide.x" in refuse("simulate", "--model", "slide.fmu")


def test_a_run_begins_anew_and_steps_are_those_of_a_whole_run(folder: Path) -> None:
    about = read_description(build_fmu(Path("slide.fmu")))
    ports = {name: find_variable(about, name, (kind,), Place("map"))
             for name, kind in (("u", "input"), ("slide.x", "output"), ("k", "parameter"), ("is_big", "parameter"))}
    unit = Unit(about, [Port("u", ports["u"])], [Port("x", ports["slide.x"])],
                [Port("k", ports["k"]), Port("big", ports["is_big"])], 1e-3)
    drive = np.sin(np.arange(50) / 5)
    whole = unit.run({"k": 3.0}, np.column_stack([drive, drive]))
    steps = [unit.begin({"k": 3.0}), *(unit.step(u, 0.0) for u in drive[:-1])]
    np.testing.assert_array_equal(np.array(steps), whole)
    assert np.abs(unit.run({"k": 3.0, "big": 1.0}, np.column_stack([drive, drive]))).max() < np.abs(whole).max() / 5
    unit.close()
    with pytest.raises(RigError, match="gives nan"):
        Unit(read_description(build_fmu(Path("nan.fmu"), does="GIVE_NAN", at=5)), [Port("u", ports["u"])],
             [Port("x", ports["slide.x"])], [], 1e-3).run({}, np.zeros((20, 2)))


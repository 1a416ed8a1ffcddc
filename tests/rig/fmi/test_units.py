"""Exported units are valid and have the bits of `rig simulate`; foreign ones are plants, bad ones end in a line."""

import json
import re
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from c_device import needs_compiler, skip_without_compiler
from effect_files import HEAD, restored_catalogue
from places import ROOT
from rig_command import answer, refuse, rig, write_file

from fdi.trace import Trace
from plant import Lanes, Model, Place, RigError, load_model, simulate
from rig.fmi import foreign
from rig.fmi.export import export_fmu
from rig.fmi.foreign import Port, Unit, find_variable, read_description

fmpy = pytest.importorskip("fmpy")
from foreign_fmu import build_fmu  # noqa: E402

CYCLES = 1200
T = np.arange(CYCLES) * 1e-3
COMMAND = 1e-3 * np.sin(2 * np.pi * 3 * T) + 2e-3 * (T > 0.7)
LOAD = 2000 * np.sin(9 * T)
MODELS: dict[str, dict[str, object]] = {
    "nominal": {},
    "effects with memory, noise and quantisation": {
        "transport_delay.cycles": 2, "coil_lag.time": 1e-3, "quantisation.lsb": 1e-6, "null_bias.current": 1e-4,
        "current_noise.white": 1e-4, "spool.static_friction": 30.0},
}


@cache
def build(folder: Path, name: str, version: str) -> Path:
    """The unit of a model of MODELS, or of a shipped one."""
    skip_without_compiler()
    out = folder / f"{len(list(folder.iterdir()))}.fmu"
    export_fmu(choose_model(name), out, version, seed=7)
    return out


def choose_model(name: str) -> Model:
    """A model of MODELS, or a shipped one."""
    return load_model("eha").replace(MODELS[name]) if name in MODELS else load_model(name)


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """Exports a model once: unit(model, version)."""
    folder = tmp_path_factory.mktemp("units")
    return lambda name, version: build(folder, name, version)


@pytest.mark.parametrize(("name", "version"), [*((name, version) for name in MODELS for version in "23"),
                                               ("ehs", "3")])
def test_a_unit_is_valid_and_has_the_bits_of_rig_simulate(
    unit: Callable[[str, str], Path], name: str, version: str
) -> None:
    from fmpy.validation import validate_fmu

    path, model = unit(name, version), choose_model(name)
    assert validate_fmu(str(path)) == []
    reference = simulate(model, COMMAND, LOAD, seed=7)
    drive = np.r_[0.0, reference.cor[:-1]]
    outputs = [signal.name for signal in model.kind.signals.outputs]
    rows = np.array(list(zip(T, COMMAND, drive, LOAD, strict=True)),
                    [(column, float) for column in ("time", "com", "cor", "load")])
    for is_closed in (True, False):
        unit_rows = fmpy.simulate_fmu(str(path), stop_time=T[-1], step_size=1e-3, output_interval=1e-3, input=rows,
                                      start_values={"closed_loop": is_closed}, output=[*outputs, "answer"])
        for signal in outputs:
            assert unit_rows[signal].tobytes() == getattr(reference, signal).tobytes(), (signal, is_closed)
    assert np.ptp(reference.xj) > 1e-3


def test_a_unit_needs_no_interpreter_and_two_exports_are_one_file(
    unit: Callable[[str, str], Path], tmp_path: Path
) -> None:
    path = unit("nominal", "2")
    again = tmp_path / "again.fmu"
    platforms = export_fmu(choose_model("nominal"), again, "2", seed=7)
    assert again.read_bytes() == path.read_bytes()
    assert platforms[0] in ("linux64", "aarch64-linux")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    description = (tmp_path / "modelDescription.xml").read_text()
    (guid,) = re.findall(r'guid="([^"]+)"', description)
    ((first, _), *_) = outputs = re.findall(r'valueReference="(\d+)"[^>]+causality="(output)"', description)
    (seed_at,) = re.findall(r'name="seed" valueReference="(\d+)"', description)
    driver = tmp_path / "drive_fmu"
    source = Path(__file__).parents[2] / "support" / "drive_fmu.c"
    subprocess.run(["cc", str(source), "-o", str(driver), "-ldl"], check=True)
    words = [driver, tmp_path / "binaries" / platforms[0] / "eha.so", guid, 7, 1e-3, first, len(outputs) - 1, seed_at]
    result = subprocess.run([str(word) for word in words], input="\n".join(x.hex() for x in COMMAND.tolist()),
                            capture_output=True, text=True, check=True)
    rows = np.array([[float.fromhex(word) for word in line.split()] for line in result.stdout.splitlines()])
    reference = simulate(choose_model("nominal"), COMMAND, seed=7)
    assert rows.tobytes() == np.column_stack([reference.xj, reference.p12, reference.xs]).tobytes()


class Instance:
    """An instance of a unit, by FMPy, whose functions have other names in version 2 than in 3."""

    def __init__(self, folder: str, token: str = "") -> None:
        from fmpy import fmi2, fmi3

        about = fmpy.read_model_description(folder)
        self.is_old = about.fmiVersion == "2.0"
        make: Any = fmi2.FMU2Slave if self.is_old else fmi3.FMU3Slave
        self.fmu = make(guid=token or about.guid, unzipDirectory=folder,
                        modelIdentifier=about.coSimulation.modelIdentifier, instanceName="unit")
        self.fmu.instantiate()
        self.places = {variable.name: variable.valueReference for variable in about.modelVariables}

    def start(self) -> None:
        """Through initialisation."""
        if self.is_old:
            self.fmu.setupExperiment()
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, name: str, value: float) -> None:
        """Set a real variable."""
        (self.fmu.setReal if self.is_old else self.fmu.setFloat64)([self.places.get(name, 9999)], [value])

    def set_seed(self, value: int) -> None:
        """Set the parameter `seed`."""
        (self.fmu.setInteger if self.is_old else self.fmu.setInt32)([self.places["seed"]], [value])

    def get(self, name: str) -> float:
        """A real variable."""
        return float((self.fmu.getReal if self.is_old else self.fmu.getFloat64)([self.places[name]])[0])

    def run(self, first: int, cycles: int) -> list[float]:
        """XJ of some cycles under a current that changes."""
        positions = []
        for k in range(first, first + cycles):
            self.set("cor", 2e-3 * np.sin(k / 9))
            self.fmu.doStep(k * 1e-3, 1e-3)
            positions.append(self.get("xj"))
        return positions


def is_refused(call: Callable[..., object], *words: object) -> bool:
    from fmpy.fmi1 import FMICallException

    try:
        call(*words)
    except FMICallException:
        return True
    return False


@pytest.fixture(params=["2", "3"])
def make_instance(request: pytest.FixtureRequest, unit: Callable[[str, str], Path], tmp_path: Path) -> Any:
    """Instances of a unit with effects that remember."""
    return partial(Instance, fmpy.extract(str(unit([*MODELS][1], request.param)), str(tmp_path)))


def test_states_are_saved_restored_and_serialised(make_instance: Callable[[], Instance]) -> None:
    one, other = make_instance(), make_instance()
    one.start()
    other.start()
    one.run(0, 50)
    state = one.fmu.getFMUState()
    onward = one.run(50, 50)
    one.fmu.setFMUState(state)
    assert one.run(50, 50) == onward
    data = one.fmu.serializeFMUState(state)
    other.fmu.setFMUState(other.fmu.deserializeFMUState(data))
    assert other.run(50, 50) == onward
    assert all(is_refused(other.fmu.deserializeFMUState, each) for each in (data[:-1], bytes(len(data))))
    one.fmu.freeFMUState(state)
    one.fmu.reset()
    one.start()
    first = one.run(0, 50)
    one.fmu.reset()
    one.set_seed(8)
    one.start()
    assert one.run(0, 50) != first


def test_wrong_calls_are_refused_and_the_unit_goes_on(make_instance: Callable[..., Instance]) -> None:
    with pytest.raises(Exception, match="instantiate"):
        make_instance("{other}")
    one = make_instance()
    step = one.fmu.doStep
    assert is_refused(step, 0.0, 1e-3) and is_refused(one.get, "xj") and is_refused(one.fmu.exitInitializationMode)
    one.set("spool.mass", 0.09)
    for name, value in (("spool.mass", -1.0), ("spool.mass", float("nan")), ("xj", 0.0), ("time", 1.0), ("none", 0.0),
                        ("filter.clogging", 1.0), ("load", float("inf"))):
        assert is_refused(one.set, name, value), name
    assert is_refused(one.set_seed, -1)
    one.start()
    assert one.get("spool.mass") == 0.09
    assert is_refused(one.set, "controller.period", 2e-3) and is_refused(one.set_seed, 1)  # fixed
    for t, length in ((0.5, 1e-3), (0.0, 1.5e-3), (0.0, 0.0), (0.0, -1e-3), (float("nan"), 1e-3), (0.0, 1e30)):
        assert is_refused(step, t, length), (t, length)
    step(0.0, 3e-3)
    assert one.get("time") == 3e-3 and is_refused(one.fmu.enterInitializationMode)
    one.fmu.reset()
    assert is_refused(one.get, "xj")
    one.start()
    step(0.0, 1e-3)
    one.fmu.terminate()
    assert is_refused(step, 1e-3, 1e-3)


def test_messages_reach_the_logger(unit: Callable[[str, str], Path], tmp_path: Path) -> None:
    from fmpy.fmi3 import FMU3Slave, fmi3LogMessageCallback

    path = unit("nominal", "3")
    messages: list[str] = []
    description = fmpy.read_model_description(str(path))
    slave = FMU3Slave(guid=description.guid, unzipDirectory=fmpy.extract(str(path), str(tmp_path)),
                      modelIdentifier=description.coSimulation.modelIdentifier, instanceName="unit")
    slave.instantiate(logMessage=fmi3LogMessageCallback(lambda _e, _s, _c, text: messages.append(text.decode())))
    with pytest.raises(Exception, match="fmi3DoStep"):
        slave.doStep(0.0, 1e-3)
    assert messages == ["fmi3DoStep: not allowed in this state of the unit"]
    slave.freeInstance()


# ---------------------------------------------------------------------------------- the command


@needs_compiler
def test_rig_export_writes_units_and_refuses_bad_words(tmp_path: Path) -> None:
    out = tmp_path / "unit.fmu"
    export = answer("export", "--fmu", out, "--fmi", "3", "--set", "spool.static_friction=35")
    assert (export["path"], export["fmi"]) == (str(out), "3") and export["platforms"]
    description = fmpy.read_model_description(str(out))
    (friction,) = [v for v in description.modelVariables if v.name == "spool.static_friction"]
    assert (float(friction.start), friction.unit, friction.variability) == (35.0, "N", "tunable")
    assert "a file that does not exist yet" in refuse("export", "--fmu", out)
    assert "a file .fmu" in refuse("export", "--fmu", tmp_path / "unit.zip")
    assert "no TRACE" in refuse("export", "run.csv", "--fmu", tmp_path / "b.fmu")
    assert "a trace to export" in refuse("export")


@needs_compiler
def test_effects_of_a_user_are_exported_unless_they_need_more_than_arithmetic(tmp_path: Path) -> None:
    law, out = tmp_path / "law.py", tmp_path / "law.fmu"
    with restored_catalogue():
        law.write_text(HEAD + LAW)
        assert answer("export", "--fmu", out, "--effects", law, "--set", "root.gain=1e-3")["count"] == 1
        assert len(fmpy.simulate_fmu(str(out), stop_time=0.01, step_size=1e-3, output_interval=1e-3)) == 11
        with pytest.raises(Exception, match="status 3"):  # NaN: it has diverged
            fmpy.simulate_fmu(str(out), stop_time=0.01, step_size=1e-3, output_interval=1e-3,
                              start_values={"root.gain": -1.0})
    law.write_text(HEAD + LAW.replace("return x +", "return [0.0, x][int(x > 0.0)] +"))
    assert "laws that need nothing but arithmetic" in refuse(
        "export", "--fmu", out, "--force", "--effects", law, "--set", "root.gain=1e-3")


LAW = '''
class Root(NamedTuple):
    gain: Annotated[float, Quantity("1")] = 0.0

@effect("reading", Root, law="XJ = XJ + sqrt gain")
def root(x, s, u, p):
    return x + p.root.gain ** 0.5 * pi
'''


def test_without_a_compiler_one_line_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "a C compiler to link the FMU with" in refuse("export", "--fmu", tmp_path / "a.fmu")


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
FAULT = """
[faults.strong]
title = "strong drive"
parameter = "drive.gain"
range = [2, 8]
acceptable = 3
maintenance = 5
"""
SHORT = """
title = "Short"
setup = [{ kind = "hold", time = 0.02 }]
main = [{ name = "rest", kind = "hold", time = 0.05 }, { name = "step", kind = "step", to = 1e-3, time = 0.2 }]
cleanup = [{ kind = "hold", time = 0.02 }]
"""


@pytest.fixture
def folder(here: Path) -> Path:
    """The present folder, with a model file of a slide and a short sequence."""
    skip_without_compiler()
    Path("slide.toml").write_text(SLIDE)
    Path("short.toml").write_text(SHORT)
    rows = ((t, 1e-3 * (t > 0.2) + 5e-4 * np.sin(9 * t)) for t in np.arange(0, 1.5, 0.01))
    Path("command.csv").write_text("t,com\n" + "".join(f"{t:.2f},{com:.6f}\n" for t, com in rows))
    return here


@pytest.mark.parametrize("version", [pytest.param("2", marks=pytest.mark.slow), "3"])
def test_the_exported_eha_gives_its_own_rows_again(folder: Path, version: str) -> None:
    export_fmu(load_model(), Path("eha.fmu"), version)
    plain_model, unit_model = load_model(), load_model("eha.fmu")
    com = 1e-3 * np.sin(np.arange(600) / 50)
    load = 800 * np.cos(np.arange(600) / 70)
    changes = {"spool.static_friction": 25.0}
    reference = simulate(plain_model.replace(changes), com, load, seed=3)
    unit_run = simulate(unit_model.replace(changes), com, load, seed=3)
    assert [a.tobytes() for a in unit_run] == [b.tobytes() for b in reference]
    values = np.array([[20.0], [40.0]])
    quiet = dict.fromkeys(("sensors.position_noise", "sensors.pressure_noise", "sensors.spool_noise"), 0.0)
    runs = [Lanes(model.replace(quiet), ["spool.static_friction"], 100).replay(
        values, reference.cor, load, reference.xj, 5.0) for model in (plain_model, unit_model)]
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
    # the steps of a foreign unit are not known, nor is their error
    assert answer("compare", "run.csv", "--model", "slide.toml").items() >= {
        ("verdict", "WITHIN_FLOOR"), ("solver_error", None)}
    other = answer("compare", "run.csv", "--model", "slide.toml", "--set", "drive.gain=2.2", status=1)
    assert other["verdict"] == "MODEL_INCOMPLETE"
    learn = ("fdi", "--faults", write_file(Path("faults.toml"), FAULT), "--out", "bands.toml", "--learn-bands")
    for line, *words in (("a plant with equations", "explain", "run.csv"),
                         ("units the rig simulates side by side", *learn, "--command", "command.csv"),
                         ("at least 5 healthy", *learn, "run.csv"),
                         ("from 0.5 to 10", "simulate", "--set", "drive.gain=12"),
                         ("an FMU has steps of its own", "simulate", "--steps", 5, "--command", "command.csv")):
        assert line in refuse(*words, "--model", "slide.toml")


def test_identify_finds_the_parameters_that_the_map_gives_a_range_also_where_trials_diverge(folder: Path) -> None:
    build_fmu(Path("slide.fmu"), does="DIVERGE")
    Path("command.csv").write_text("\n".join(Path("command.csv").read_text().splitlines()[:60]))
    answer("simulate", "--model", "slide.toml", "--command", "command.csv", "--set", "drive.gain=2.4", "--out",
           "run.csv")
    identification = answer("identify", "run.csv", "--model", "slide.toml", "--out", "found.toml")
    assert identification["parameters"]["drive.gain"]["value"] == pytest.approx(2.4, rel=0.01)


@pytest.mark.parametrize(("fault", "message"), [
    ({"does": "CRASH", "at": 100}, "the unit crashed in step (SIGSEGV); its last message: about to fail"),
    ({"does": "HANG", "at": 100}, "the unit has not answered for 4 s in step; it was stopped"),
    ({"does": "REFUSE", "at": 100}, "at 0.1 s; its message: the solver did not converge"),
    ({"does": "GIVE_NAN", "at": 100}, "the unit gives nan for xj at 0.101 s"),
])
def test_a_unit_that_breaks_ends_the_run_with_a_verdict_and_a_readable_log(
    folder: Path, fault: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    build_fmu(Path("slide.fmu"), **fault)
    monkeypatch.setattr(foreign, "LONGEST_CALL", 4.0)  # loading takes a second on a busy machine
    assert message in refuse("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")
    result = rig("run", "short.toml", "--model", "slide.toml", "--out", "run", "--quiet")
    assert result.status == 1, result
    verdict = json.loads(Path("run", "verdict.json").read_text())
    assert verdict["verdict"] == "ABORTED" and message in json.dumps(verdict)
    assert len(Trace.read("run", all=True)) > 50


@pytest.mark.parametrize(("kind", "message"), [
    ({"platform": "win64"}, "slide.so; it has only binaries/win64/slide.so"),
    ({"sources": True}, "it has none and source code: python -m fmpy compile slide.fmu"),
    ({"fmi": "1.0"}, "fmiVersion: expected 2.0 or 3.0, not 1.0"),
    ({"kind": "ModelExchange"}, "an FMU for co-simulation; this one is for model exchange only"),
    ({"unit": 'needsExecutionTool="true"', "does": "REFUSE", "at": 1}, "needs the tool that made it"),
    ({"unit": 'fixedInternalStepSize="0.0003"'}, "a step of which the cycle of 1 ms is a multiple, not 0.3 ms"),
    ({"does": "EVENT_MODE"}, "its message: this unit needs event mode"),
    ({"does": "TOKEN"}, "at 0 s; the guid, or instantiationToken, in its modelDescription.xml may not"),
    ({"does": "END", "at": 3}, "the unit asks to end the simulation"),
])
def test_a_unit_that_cannot_run_here_is_refused(folder: Path, kind: dict[str, Any], message: str) -> None:
    build_fmu(Path("slide.fmu"), **kind)
    assert message in refuse("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")


@pytest.mark.parametrize(("old", "new", "message"), [  # replaced in SLIDE
    ('file = "slide.fmu"', 'file = "none.fmu"', "none.fmu: expected an FMU; it does not exist"),
    ('file = "slide.fmu"', 'file = "slide.toml"', "an FMU, a zip archive with a modelDescription.xml"),
    ('"slide.x"', '"slide.y"', "a variable of slide.fmu, not 'slide.y'; did you mean slide.x?"),
    ('variable = "u"', 'variable = "slide.x"', "a variable that is input; slide.x is output"),
    ('count = "1 mm"', 'count = "1 bar"', "not 'bar'"),
    ('noise = "1 um"', 'noise = "1 bar"', "plant.outputs.ram_position.noise: expected one of m,"),
    ("[plant.inputs]", "[plant.input]", "plant.input: expected one of file, seed, inputs, outputs, parameters"),
    ('load_force = {', 'torque = {', "one signal that drives the plant"),
    ('drive.damping = "d"', 'damping = "d"', "GROUP.NAME = VARIABLE"),
    ("damping = 8.0\n", "", "slide.toml:12: plant.parameters.drive.damping: expected a start value of d in the unit"),
    ("gain = 2.0\n", "", "or drive.gain in this file: a number from 0.5 to 10; the unit has 0"),
    ("gain = 2.0", "is_big = 0.5\ngain = 2.0", "drive.is_big: expected a whole number from 0 to 1, not 0.5"),
])
def test_a_wrong_map_is_refused_with_its_line(folder: Path, old: str, new: str, message: str) -> None:
    build_fmu(Path("slide.fmu"))
    Path("slide.toml").write_text(SLIDE.replace(old, new))
    assert message in refuse("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")


@pytest.mark.parametrize("version", ["2", "3"])
def test_a_unit_may_lack_functions_that_nobody_calls_and_may_exist_once(folder: Path, version: str) -> None:
    """FMPy looks for all functions of the interface; a unit that may exist once is reset between runs."""
    build_fmu(Path("slide.fmu"), version, unit='canBeInstantiatedOnlyOncePerProcess="true"', stubs=False)
    answer("simulate", "--model", "slide.toml", "--command", "command.csv", "--out", "run.csv")
    assert answer("compare", "run.csv", "--model", "slide.toml")["verdict"] == "WITHIN_FLOOR"


def test_a_drive_of_its_own_has_no_limit_of_the_shipped_actuator(folder: Path) -> None:
    build_fmu(Path("slide.fmu"))
    Path("own.toml").write_text(SLIDE.replace("current =", "torque =").replace("1 mA", "1 N m"))
    assert [(each.kind.signals.drive.limit, each["controller.current_limit"] > 1e6)
            for each in map(load_model, ("own.toml", "slide.toml"))] == [
                ("", True), ("controller.current_limit", False)]


def test_a_run_has_the_period_of_the_model_file(folder: Path) -> None:
    build_fmu(Path("slide.fmu"))
    model_text = SLIDE.replace("current =", "torque =").replace("1 mA", "1 N m").replace("ram_position", "angle")
    Path("own.toml").write_text(model_text.replace("[controller]", "[controller]\nperiod = 2e-3"))
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

"""Exported units: valid by FMPy, the bits of `rig simulate` in both versions, states, parameters, wrong calls."""

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
from c_device import skip_without_compiler
from effect_files import HEAD, restored_catalogue
from rig_command import answer, refuse

from plant import Model, load_model, simulate
from rig.fmi.export import export_fmu, find_exponents

fmpy = pytest.importorskip("fmpy")

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
                                               ("servo", "3")])
def test_a_unit_is_valid_and_has_the_bits_of_rig_simulate(
    unit: Callable[[str, str], Path], name: str, version: str
) -> None:
    from fmpy.validation import validate_fmu

    path, model = unit(name, version), choose_model(name)
    assert validate_fmu(str(path)) == []
    expected = simulate(model, COMMAND, LOAD, seed=7)
    drive = np.r_[0.0, expected.cor[:-1]]
    outputs = [signal.name for signal in model.kind.signals.outputs]
    rows = np.array(list(zip(T, COMMAND, drive, LOAD, strict=True)),
                    [(column, float) for column in ("time", "com", "cor", "load")])
    for is_closed in (True, False):
        found = fmpy.simulate_fmu(str(path), stop_time=T[-1], step_size=1e-3, output_interval=1e-3, input=rows,
                                  start_values={"closed_loop": is_closed}, output=[*outputs, "answer"])
        for signal in outputs:
            assert found[signal].tobytes() == getattr(expected, signal).tobytes(), (signal, is_closed)
    assert np.ptp(expected.xj) > 1e-3


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
    ((first, _), *_) = found = re.findall(r'valueReference="(\d+)"[^>]+causality="(output)"', description)
    (seed_at,) = re.findall(r'name="seed" valueReference="(\d+)"', description)
    driver = tmp_path / "drive_fmu"
    source = Path(__file__).parents[2] / "support" / "drive_fmu.c"
    subprocess.run(["cc", str(source), "-o", str(driver), "-ldl"], check=True)
    words = [driver, tmp_path / "binaries" / platforms[0] / "eha.so", guid, 7, 1e-3, first, len(found) - 1, seed_at]
    said = subprocess.run([str(word) for word in words], input="\n".join(x.hex() for x in COMMAND.tolist()),
                          capture_output=True, text=True, check=True)
    rows = np.array([[float.fromhex(word) for word in line.split()] for line in said.stdout.splitlines()])
    expected = simulate(choose_model("nominal"), COMMAND, seed=7)
    assert rows.tobytes() == np.column_stack([expected.xj, expected.p12, expected.xs]).tobytes()


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
        found = (self.fmu.getReal if self.is_old else self.fmu.getFloat64)([self.places[name]])
        return float(found[0])

    def run(self, first: int, cycles: int) -> list[float]:
        """XJ of some cycles under a current that changes."""
        found = []
        for k in range(first, first + cycles):
            self.set("cor", 2e-3 * np.sin(k / 9))
            self.fmu.doStep(k * 1e-3, 1e-3)
            found.append(self.get("xj"))
        return found


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
    saved = one.fmu.getFMUState()
    onward = one.run(50, 50)
    one.fmu.setFMUState(saved)
    assert one.run(50, 50) == onward
    data = one.fmu.serializeFMUState(saved)
    other.fmu.setFMUState(other.fmu.deserializeFMUState(data))
    assert other.run(50, 50) == onward
    assert is_refused(other.fmu.deserializeFMUState, data[:-1])
    assert is_refused(other.fmu.deserializeFMUState, bytes(len(data)))
    one.fmu.freeFMUState(saved)
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
    said: list[str] = []
    described = fmpy.read_model_description(str(path))
    slave = FMU3Slave(guid=described.guid, unzipDirectory=fmpy.extract(str(path), str(tmp_path)),
                      modelIdentifier=described.coSimulation.modelIdentifier, instanceName="unit")
    slave.instantiate(logMessage=fmi3LogMessageCallback(lambda _e, _s, _c, text: said.append(text.decode())))
    with pytest.raises(Exception, match="fmi3DoStep"):
        slave.doStep(0.0, 1e-3)
    assert said == ["fmi3DoStep: not allowed in this state of the unit"]
    slave.freeInstance()


# ---------------------------------------------------------------------------------- the command


def test_rig_export_writes_units_and_refuses_bad_words(tmp_path: Path) -> None:
    skip_without_compiler()
    out = tmp_path / "unit.fmu"
    found = answer("export", "--fmu", out, "--fmi", "3", "--set", "spool.static_friction=35")
    assert (found["path"], found["fmi"]) == (str(out), "3") and found["platforms"]
    described = fmpy.read_model_description(str(out))
    (friction,) = [v for v in described.modelVariables if v.name == "spool.static_friction"]
    assert (float(friction.start), friction.unit, friction.variability) == (35.0, "N", "tunable")
    assert "a file that does not exist yet" in refuse("export", "--fmu", out)
    assert "a file .fmu" in refuse("export", "--fmu", tmp_path / "unit.zip")
    assert "no TRACE" in refuse("export", "run.csv", "--fmu", tmp_path / "b.fmu")
    assert "a trace to export" in refuse("export")


def test_effects_of_a_user_are_exported_unless_they_need_more_than_arithmetic(tmp_path: Path) -> None:
    skip_without_compiler()
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


def test_units_are_split_into_si_units() -> None:
    assert find_exponents("N m s2/m") == {"kg": 1, "m": 1}
    assert find_exponents("m3/s/Pa") == {"kg": -1, "m": 4, "s": 1}
    assert find_exponents("m rms") == {"m": 1} and find_exponents("1") == {} and find_exponents("raw/m") is None

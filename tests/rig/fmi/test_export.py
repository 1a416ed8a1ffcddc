"""Exported units: valid by FMPy, the bits of `rig simulate` in both versions, states, parameters, wrong calls."""

import ctypes
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from ctypes import byref, c_bool, c_double, c_int32, c_size_t, c_uint32, c_void_p
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

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


# ---------------------------------------------------------------------------------- the interface itself, by ctypes


class Bare(NamedTuple):
    """A loaded library: its functions by name without fmi2 or fmi3, and what it needs to be used."""

    library: Any
    version: str
    token: bytes
    places: dict[str, int]  # value references

    def call(self, name: str, *words: Any) -> int:
        """The status of a function."""
        function = getattr(self.library, f"fmi{self.version}{name}")
        function.restype = ctypes.c_int
        return int(function(*words))

    def create(self, token: bytes | None = None, name: bytes | None = b"unit", kind: int = 1) -> c_void_p:
        """An instance, or a null pointer."""
        if self.version == "2":
            function = self.library.fmi2Instantiate
            words: tuple[Any, ...] = (name, kind, token or self.token, None, None, 0, 1)
        else:
            function = self.library.fmi3InstantiateCoSimulation
            words = (name, token or self.token, None, c_bool(False), c_bool(True), c_bool(kind != 1), c_bool(False),
                     None, c_size_t(0), None, None, None)
        function.restype = c_void_p
        return c_void_p(function(*words))

    def start(self, c: c_void_p) -> None:
        """Through initialisation."""
        if self.version == "2":
            assert self.call("SetupExperiment", c, 0, c_double(0), c_double(0), 0, c_double(0)) == 0
            assert self.call("EnterInitializationMode", c) == 0
        else:
            assert self.enter(c) == 0
        assert self.call("ExitInitializationMode", c) == 0

    def enter(self, c: c_void_p, t: float = 0.0) -> int:
        """Enter the initialisation of version 3."""
        return self.call("EnterInitializationMode", c, c_bool(False), c_double(0), c_double(t), c_bool(False),
                         c_double(0))

    def step(self, c: c_void_p, t: float, length: float = 1e-3) -> int:
        """One communication step."""
        if self.version == "2":
            return self.call("DoStep", c, c_double(t), c_double(length), 1)
        answers = [byref(c_bool()), byref(c_bool()), byref(c_bool()), byref(c_double())]
        return self.call("DoStep", c, c_double(t), c_double(length), c_bool(True), *answers)

    def _access(self, verb: str, c: c_void_p, name: str, value: Any, kind: str) -> int:
        word = {"real": "Real", "integer": "Integer", "boolean": "Boolean"}[kind]
        if self.version == "3":
            word = {"real": "Float64", "integer": "Int32", "boolean": "Boolean"}[kind]
        place = c_uint32(self.places.get(name, 9999))
        more = (c_size_t(1),) if self.version == "3" else ()
        return self.call(verb + word, c, byref(place), c_size_t(1), byref(value), *more)

    def set(self, c: c_void_p, name: str, value: float) -> int:
        """Set a real variable."""
        return self._access("Set", c, name, c_double(value), "real")

    def set_seed(self, c: c_void_p, value: int) -> int:
        """Set the parameter `seed`."""
        return self._access("Set", c, "seed", c_int32(value), "integer")

    def get(self, c: c_void_p, name: str) -> float | None:
        """A real variable; None where the unit refuses."""
        value = c_double()
        return value.value if self._access("Get", c, name, value, "real") == 0 else None

    def run(self, c: c_void_p, first: int, cycles: int) -> list[float | None]:
        """XJ of some cycles under a current that changes."""
        found = []
        for k in range(first, first + cycles):
            assert self.set(c, "cor", 2e-3 * np.sin(k / 9)) == 0 and self.step(c, k * 1e-3) == 0
            found.append(self.get(c, "xj"))
        return found


@pytest.fixture(scope="module", params=["2", "3"])
def bare(request: pytest.FixtureRequest, unit: Callable[[str, str], Path], tmp_path_factory: Any) -> Bare:
    """The library of a unit with effects that remember."""
    folder = tmp_path_factory.mktemp("bare")
    with zipfile.ZipFile(unit([*MODELS][1], request.param)) as archive:
        archive.extractall(folder)
    description = (folder / "modelDescription.xml").read_text()
    (token,) = re.findall(r'(?:guid|instantiationToken)="([^"]+)"', description)
    places = {name: int(place) for name, place in re.findall(r'name="([^"]+)" valueReference="(\d+)"', description)}
    (path,) = [path for path in folder.rglob("*.so") if ("aarch64" in path.parent.name) == ("aarch64" in sys.platform)]
    return Bare(ctypes.CDLL(str(path)), request.param, token.encode(), places)


def test_states_are_saved_restored_and_serialised(bare: Bare) -> None:
    name = "FMUstate" if bare.version == "2" else "FMUState"
    deserialize = "DeSerialize" if bare.version == "2" else "Deserialize"
    c, other = bare.create(), bare.create()
    for each in (c, other):
        bare.start(each)
    bare.run(c, 0, 50)
    saved, size = c_void_p(), c_size_t()
    assert bare.call(f"Get{name}", c, byref(saved)) == 0
    onward = bare.run(c, 50, 50)
    assert bare.call(f"Set{name}", c, saved) == 0 and bare.run(c, 50, 50) == onward
    assert bare.call(f"Serialized{name}Size", c, saved, byref(size)) == 0
    data = ctypes.create_string_buffer(size.value)
    assert bare.call(f"Serialize{name}", c, saved, data, size) == 0
    moved = c_void_p()
    assert bare.call(f"{deserialize}{name}", other, data, size, byref(moved)) == 0
    assert bare.call(f"Set{name}", other, moved) == 0 and bare.run(other, 50, 50) == onward
    assert bare.call(f"{deserialize}{name}", other, data, c_size_t(size.value - 1), byref(c_void_p())) == 3
    assert bare.call(f"{deserialize}{name}", other, b"\0" * size.value, size, byref(c_void_p())) == 3
    assert bare.call(f"Free{name}", c, byref(saved)) == 0 and saved.value is None
    assert bare.call(f"Free{name}", c, byref(saved)) == 0  # freeing none is allowed
    assert bare.call(f"Set{name}", c, saved) == 3
    assert bare.call("Reset", c) == 0
    bare.start(c)
    first = bare.run(c, 0, 50)
    assert bare.call("Reset", c) == 0 and bare.set_seed(c, 8) == 0
    bare.start(c)
    assert bare.run(c, 0, 50) != first
    for each in (c, other):
        bare.call("FreeInstance", each)


def test_wrong_calls_are_refused_and_the_unit_goes_on(bare: Bare) -> None:
    assert not bare.create(b"{other}") and not bare.create(name=b"") and not bare.create(kind=0)
    none = c_void_p()
    assert (bare.step(none, 0.0), bare.set(none, "load", 1.0), bare.call("Terminate", none)) == (3, 3, 3)
    c = bare.create()
    assert bare.step(c, 0.0) == 3 and bare.get(c, "xj") is None and bare.call("ExitInitializationMode", c) == 3
    if bare.version == "3":
        assert bare.enter(c, float("nan")) == 3
    assert bare.set(c, "spool.mass", 0.09) == 0
    for name, value in (("spool.mass", -1.0), ("spool.mass", float("nan")), ("xj", 0.0), ("time", 1.0), ("none", 0.0),
                        ("filter.clogging", 1.0), ("load", float("inf"))):
        assert bare.set(c, name, value) == 3, name
    assert bare.set_seed(c, -1) == 3
    bare.start(c)
    assert bare.get(c, "spool.mass") == 0.09
    assert bare.set(c, "controller.period", 2e-3) == 3 and bare.set_seed(c, 1) == 3  # fixed
    for t, length in ((0.5, 1e-3), (0.0, 1.5e-3), (0.0, 0.0), (0.0, -1e-3), (float("nan"), 1e-3), (0.0, 1e30)):
        assert bare.step(c, t, length) == 3, (t, length)
    assert bare.step(c, 0.0, 3e-3) == 0 and bare.get(c, "time") == 3e-3
    assert bare.call("EnterInitializationMode", c) == 3 if bare.version == "2" else bare.enter(c) == 3
    assert bare.call("Reset", c) == 0 and bare.get(c, "xj") is None
    bare.start(c)
    assert bare.step(c, 0.0) == 0 and bare.call("Terminate", c) == 0 and bare.step(c, 1e-3) == 3
    bare.call("FreeInstance", c)


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
    with restored_catalogue():
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

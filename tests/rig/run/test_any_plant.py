"""Benches and runs of plants with signals of their own: an EMA with a drive, and a user's plant in one file."""

from pathlib import Path

import numpy as np
import pytest
from bus_stations import only_udp, spec
from example_devices import DRIVE, PATIENT, run_device
from places import ROOT
from rig_command import CommandResult, refuse, rig, write_file

from fdi.discovery.explain import compute_firmware_residual
from fdi.estimation import prepare_trace, replay_current
from fdi.estimation.fit import silence_sensors
from fdi.trace import Trace
from plant import load_model

PLANT = ROOT / "tests" / "support" / "trim_jack.py"
BENCH = """
name = "Trim jack with drive"
plant = "trim_jack.py"
[controller]
node = 5
eds = "drive.eds"
profile = "cia402"
[controller.values]
"0x6075" = 1000
"0x6073" = 800
"0x2002:1" = 6.25
"0x2002:2" = 0.43
[controller.inputs]
trim_cmd = { object = "0x607A", count = "1 urad" }
trim_angle = { object = "0x2001", count = "1 mrad" }
[controller.outputs]
torque_ref = { object = "0x6078", count = "1 mN m" }
"""
SHORT = """
title = "A step"
setup = [{ kind = "hold", time = 0.05 }]
main = [{ kind = "hold", time = 0.05 }, { name = "step", kind = "step", to = 2e-3, time = 1.0 }]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.1 }]
checks = [
  { name = "settled", kind = "max_error", window = "step", skip = 0.2, high = 60, unit = "um" },
  { name = "motor", kind = "never_exceeds", signal = "current", high = 21 },
]
"""


def play(folder: Path, *words: object) -> CommandResult:
    """`rig run` on the drive of the example, in lockstep on UDP."""
    where = spec("udp_multicast")
    with run_device(DRIVE, where, *PATIENT[DRIVE]):
        return rig("run", *words, "--controller", "external", "--bus", where, "--out", folder)


def write_bench(folder: Path, **changes: str) -> Path:
    """The plant and its bench file beside the drive's EDS; `changes`: of the plant's text, old to new."""
    text = PLANT.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "trim_jack.py").write_text(text)
    (folder / "drive.eds").write_bytes((DRIVE / "drive.eds").read_bytes())
    return write_file(folder / "trim.toml", BENCH)


@pytest.mark.parametrize("sequence", [pytest.param("preflight", marks=pytest.mark.slow), ""])
def test_an_ema_with_a_cia402_drive(sequence: str, tmp_path: Path) -> None:
    """It passes a step, and the whole preflight (slow); test_controllers.py has faulty drives."""
    result = play(tmp_path / "run", sequence or write_file(tmp_path / "short.toml", SHORT), "--bench",
                  DRIVE / "ema.toml")
    assert result.status == 0, result
    trace = Trace.read(tmp_path / "run")
    assert trace.signals == ("demand", "position", "current_demand", "motor_speed", "current", "load")
    assert abs(trace.position[-1] - trace.demand[-1]) < 2e-5 and abs(trace.column("motor_speed")).max() > 100.0


@only_udp
def test_from_a_plant_file_to_its_hidden_fault(where: str, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One Python file and one bench file, five measured signals: check, run, explain, run --from."""
    write_bench(here)
    Path("stiff.toml").write_text('plant = "trim_jack.py"\neffects = ["tight_seal"]\n[tight_seal]\ntorque = 0.02\n')
    report = rig("check", "preflight", "--bench", "trim.toml", "--trust", "--json").json
    bus_signals = {signal for each in report["bench"]["frames"] for signal in each["signals"]}
    assert report["verdict"] == "WITHIN_LIMITS" and {"trim_cmd", "trim_angle", "torque_ref"} <= bus_signals
    run = play(here / "hidden", "--bench", "trim.toml", "--model", "stiff.toml", "--trust")
    assert run.status == 0, run
    assert {"shaft_rate", "phase_amps", "rotor_angle", "case_rise"} <= {*Trace.read(here / "hidden").signals}
    elsewhere = here / "elsewhere"  # the log has the plant with it
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert "--trust, because it brings code along" in refuse("compare", here / "hidden")
    explanation = rig("explain", here / "hidden", "--trust", "--json").json
    assert (explanation["verdict"], explanation["effects"]) == ("EXPLAINED", ["tight_seal"])
    with run_device(DRIVE, where, *PATIENT[DRIVE]):
        again = rig("run", "--from", here / "hidden", "--trust", "--bus", where, "--out", elsewhere / "again")
    assert again.status == 0, again
    first, second = (Trace.read(folder) for folder in (here / "hidden", elsewhere / "again"))
    assert (first.column("trim_angle") == second.column("trim_angle")).all()


def test_a_plant_without_a_device_runs_with_its_own_controller(here: Path) -> None:
    """Nothing but the plant file: run, and repeat."""
    assert rig("new", "plant", "motor").status == 0
    Path("motor.py").write_text(Path("motor.py").read_text().replace('high=0.1)] = 1e-3', 'high=0.1)] = 2e-3'))
    result = rig("run", "--model", "motor.py", "--set", "dry_friction.torque=0.3", "--json", "--out", "run")
    assert (result.status, result.json["verdict"]) == (0, "PASS"), result
    assert Trace.read("run").period == 2e-3
    skipped_checks = {each["name"] for each in result.json["not_applicable"]}
    assert "same answers after a reset" in skipped_checks  # and so not counted as passed
    again = rig("run", "--from", "run", "--trust", "--out", "again")
    assert again.status == 0, again
    assert rig("diff", "run", "again", "--json").json["verdict"] == "SAME"
    assert "--trust, because it brings code along" in refuse("identify", "run")  # it takes the plant of the log
    assert "expected embedded" in refuse("run", "--model", "motor.py", "--bus", spec("udp_multicast"))
    assert "expected external" in refuse("run", "--model", "motor.py", "--controller", "c")


def test_a_replay_of_a_run_begins_with_its_set_up(tmp_path: Path) -> None:
    """There the plant rests, so it is known; bring-up leaves nothing in the integral of a law that nothing disables."""
    short = write_file(tmp_path / "short.toml", SHORT)
    silent = [f"--set=sensors.{name}_noise=0" for name in ("position", "motor_speed", "current")]
    assert rig("run", short, "--model", "ema", *silent, "--out", tmp_path / "run").status == 0
    trace, ema = Trace.read(tmp_path / "run"), silence_sensors(load_model("ema"))
    assert trace.t[0] == 0.0 and len(trace.lead["demand"]) == 50
    assert np.abs(trace.lead["current_demand"]).max() < 0.05  # A; the noise of its sensor is 0.02
    ready = prepare_trace(trace, ema)
    assert ready.t[0] == -0.05 and ready.usable.sum() == len(trace)
    # its law remembers what came before the log, so its answers cannot be told
    assert np.isnan(compute_firmware_residual(ema, ready)).all()
    for name, column in replay_current(ready, ema, ema.steps, anchor=0.0).items():
        assert np.abs(column - ready.column(name)).max() <= 1e-9 * np.abs(ready.column(name)).max()


def test_a_sequence_that_names_a_model_runs_on_the_bench_of_its_plant(tmp_path: Path) -> None:
    assert rig("run", write_file(tmp_path / "named.toml", 'model = { name = "ema" }\n' + SHORT),
               "--out", tmp_path).status == 0


def test_a_run_with_fdi_is_judged_by_the_faults_of_its_own_plant(tmp_path: Path) -> None:
    short = write_file(tmp_path / "short.toml", SHORT.replace(
        "]\ncleanup", ', { kind = "ramp", to = -2e-3, time = 0.5 }, { kind = "step", to = 0.0, time = 0.5 }]\ncleanup'))
    result = rig("run", short, "--model", "ema", "--set", "surface.friction=300", "--fdi", "--json", "--out", tmp_path)
    assert (result.status, result.json["fdi"]["verdict"]) == (1, "NON_NOMINAL"), result
    assert result.json["fdi"]["ruling"] == "dry_friction" and len(result.json["fdi"]["level"]) == 4


@pytest.mark.parametrize(("old", "new", "line"), [
    ('trim_angle = {', 'ram_position = {', "inputs.ram_position: expected a signal of the bench and its plant: "
     "'case_rise', 'control_word', 'cycle', 'flags', 'hinge', 'mode', 'phase_amps', 'rotor_angle'"),
    ('torque_ref = {', 'current = {', "outputs.current: expected a signal of the bench and its plant: 'cycle', "
     "'mode_display', 'status_word' or 'torque_ref'"),
    ('trim_cmd = { object = "0x607A", count = "1 urad" }', "", "inputs: expected also the signal trim_cmd"),
    ('"1 mN m"', '"20 mA"', "torque_ref.count: expected one of N m, mN m, kN m, not 'mA'"),
    ('plant = "trim_jack.py"', 'plant = "absent.py"', "trim.toml:3: plant: expected"),
    ('plant = "trim_jack.py"', 'plant = "emma"', "trim.toml:3: plant: expected")])
def test_a_mistake_in_a_bench_of_an_own_plant(old: str, new: str, line: str, tmp_path: Path) -> None:
    """One line that says which signals the plant has, status 2."""
    bench = write_bench(tmp_path)
    assert old in BENCH
    rig("check", "--bench", bench, "--trust")  # announces the plant, once
    bench.write_text(BENCH.replace(old, new))
    assert line in refuse("check", "--bench", bench, "--trust")


@pytest.mark.parametrize(("role", "line"), [
    ('"drive", limit="controller.torque_limit"', "expected one signal of role drive, not none"),
    ('"command", largest=2', "expected one signal of role command, not none")])
def test_a_plant_without_a_role_is_refused(role: str, line: str, tmp_path: Path) -> None:
    """A bench needs what drives the plant and what commands it."""
    result = rig("check", "--bench", write_bench(tmp_path, **{f", {role})": ")"}), "--trust")
    assert result.status == 2 and line in result.err


@pytest.mark.parametrize("command", ["check", "run", "doctor"])
def test_a_plant_file_is_code(command: str, tmp_path: Path) -> None:
    """A bench file is data that people send to each other: the plant in it runs with --trust only."""
    message = refuse(command, "--bench", write_bench(tmp_path, **{"stabiliser trim jack": "another jack"}))
    assert "expected --trust, because it brings code along that would run here: trim_jack.py" in message

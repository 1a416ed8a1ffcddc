"""`rig check`: the command of a sequence against the limits of the actuator, and the run it is predicted to make."""

import json
from pathlib import Path

import numpy as np
import pytest
from rig_command import answer, refuse, rig
from short_sequences import SHORT, job, play

from fdi.trace.trace import Trace
from plant import Model, simulate
from rig.suite.dry_run import find_capabilities, make_dry_run, plan_faults, split_jumps

FAR = """
title = "Far"
setup = [{ kind = "hold", time = 0.05 }]
main = [
  { name = "out", kind = "ramp", to = 0.05, time = 0.15 },
  { name = "end", kind = "hold", time = 0.1 },
]
load = [{ kind = "ramp", to = 4e4, time = 0.2 }]
checks = [{ name = "steps", kind = "settling_time", window = [0.0, 0.1], band = 2.0, high = 1.0 }]
guards = [{ name = "far out", signal = "xj", high = 20.0, unit = "mm" }]
"""


def test_a_sequence_within_the_limits(tmp_path: Path) -> None:
    told = answer("check", "preflight")
    largest = {each["name"]: (each["value"], each["section"]) for each in told["demands"]}
    assert (told["verdict"], told["problems"], told["not_predicted"]) == ("WITHIN_LIMITS", [], ["no emergency"])
    assert told["durations"] == {"setup": 0.5, "main": 13.5, "cleanup": 0.5}
    assert (largest["position"][0], largest["step"]) == (5e-3, (5e-3, "step 5 mm"))
    assert largest["speed"] == (pytest.approx(2 * np.pi * 20 * 1e-3, rel=0.03), "chirp")
    assert largest["acceleration"][0] == pytest.approx((2 * np.pi * 20) ** 2 * 1e-3, rel=0.03)
    assert {each["signal"] for each in told["predicted"]["limits"]} == {"xs", "cor"}  # steps; no reason to refuse it


def test_the_prediction_is_that_of_the_run(preflight: Path) -> None:
    """Predicted without a bus, whose frames round the signals: the checks come out alike."""
    dry = make_dry_run(job((Path(__file__).parents[3] / "rig" / "sequences" / "preflight.toml").read_text()))
    checks = json.loads((preflight / "verdict.json").read_text())["checks"]
    measured = {check["name"]: check["value"] for check in checks}
    assert {check.name: check.value for check in dry.checks} == pytest.approx(
        {check.name: measured[check.name] for check in dry.checks}, rel=0.25) and len(dry.checks) == 16


def test_what_is_beyond_the_limits(tmp_path: Path) -> None:
    (tmp_path / "far.toml").write_text(FAR)
    said = rig("check", tmp_path / "far.toml", "--out", tmp_path / "far.html")
    text, page = " ".join(said.out.split()), (tmp_path / "far.html").read_text()
    assert said.status == 1 and [words for words in (
        "BEYOND_LIMITS position 50 mm beyond 40 mm (jack.travel) in 'end', t = 0.150 s",
        "speed 333.3 mm/s beyond 250 mm/s (no-load speed) in 'out'", "load 40 kN beyond 30.15 kN (stall force)",
        "guard 'far out' violated at t = 0.0", "check 'steps': the command does not step here")
        if words not in text] == []
    assert [words for words in ("BEYOND_LIMITS", "<svg", "stall force", "position [mm]", "speed [mm/s]", "load [kN]",
                                "current [mA]") if words not in page] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["far.html", "far.toml"]


def test_changes_of_the_model_count_and_faults_are_not_predicted(tmp_path: Path) -> None:
    fault = 'faults = [{ kind = "parameter", parameter = "filter.clogging", value = 0.9, start = 0.0 }]'
    (tmp_path / "s.toml").write_text(f"{SHORT}\n{fault}\n")
    said = rig("check", tmp_path / "s.toml")
    assert said.status == 0 and "the prediction is without the faults of the sequence" in " ".join(said.out.split())
    told = answer("check", tmp_path / "s.toml", "--set", "jack.travel=5e-4", status=1)
    assert told["verdict"] == "BEYOND_LIMITS"
    assert told["problems"][0].startswith("position 1 mm beyond 0.5 mm (jack.travel) in 'step'")
    assert told["differences"] == "jack.travel = 0.0005 m; fault 'parameter filter.clogging' from 0 s"


FAULTS = """
faults = [
  { kind = "parameter", parameter = "filter.clogging", value = 0.9, start = 0.05, end = 0.25, ramp = 0.1 },
  { name = "some", kind = "lost", frame = "drive", start = 0.1, count = 2, every = 5 },
  { name = "biased", kind = "offset", signal = "xj", value = 1e-4, start = 0.3, end = 9.0 },
  { name = "mute", kind = "heartbeat", node = "plant", start = 0.2, end = 0.25 },
  { kind = "reset", start = 0.125 },
]
"""


def test_the_faults_of_a_sequence_are_listed_and_drawn(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SHORT + FAULTS)
    said = rig("check", tmp_path / "s.toml", "--json")
    listed = {each["name"]: each for each in said.json["faults"]}
    assert {name: (each["kind"], each["target"], each["t0"], each["t1"]) for name, each in listed.items()} == {
        "parameter filter.clogging": ("parameter", "filter.clogging", 0.05, 0.25),
        "some": ("lost", "frame drive", 0.1, 0.106), "biased": ("offset", "sensor xj", 0.3, 0.35),
        "mute": ("heartbeat", "node plant", 0.2, 0.25), "reset node": ("reset", "node controller", 0.125, 0.126)}
    assert listed["biased"]["duration"] == pytest.approx(0.05)
    assert listed["parameter filter.clogging"]["size"] == "0 to 0.900 within 100 ms"
    said = rig("check", tmp_path / "s.toml", "--out", tmp_path / "s.html")
    text = " ".join(said.out.split())
    assert "biased sensor xj 0.300 0.350 100 um" in text and "ends with main at 0.35 s, not at 9 s" in text
    page = (tmp_path / "s.html").read_text()
    assert page.count("#ffd8a8") > 5 and all(f">{name}" in page.replace("> ", ">") for name in listed)


def test_times_and_frames_of_the_list_are_those_of_the_run(tmp_path: Path) -> None:
    """The events of a run tell when each fault began and ended."""
    text = SHORT + FAULTS.replace("{ kind = \"reset\", start = 0.125 },", "")  # which would end the run
    play(job(text), tmp_path)
    planned = {each.name: (each.t0, each.t1) for each in plan_faults(job(text))}
    found = {event.text: event.t for event in Trace.read(tmp_path, all=True).events if event.kind == "fault"}
    assert len(planned) == 4
    for name, times in planned.items():
        assert (found[f"{name} begins"], found[f"{name} ends"]) == pytest.approx(times, abs=2e-3), found


def test_the_no_load_speed_is_that_of_the_simulated_ram() -> None:
    speed = float(np.diff(simulate(Model(), np.full(150, 0.035)).xj[60:110]).mean()) * 1000
    assert speed == pytest.approx(find_capabilities(Model())["no-load speed"], rel=0.05)


def test_jumps_are_no_speed() -> None:
    ramp = np.arange(10) * 1e-4
    command = np.concatenate((ramp, np.full(10, 5e-3), 5e-3 + ramp))
    speed, jumps = split_jumps(command, [0, 10, 20], 1000.0)
    assert np.flatnonzero(jumps).tolist() == [10] and jumps[10] == pytest.approx(5e-3 - 9e-4)
    assert speed.max() == pytest.approx(0.1)
    speed, jumps = split_jumps(np.arange(30) * 1e-4, [0, 10, 20], 1000.0)  # a line through three sections
    assert not jumps.any() and np.abs(speed[1:] - 0.1).max() < 1e-9


@pytest.mark.parametrize(("words", "line"), [
    (("nothing",), "expected a .toml file"), (("preflight", "--out", "x.png"), "FILE.html"),
    (("preflight", "--set", "jack.mas=1"), "did you mean mass"),
    (("preflight", "--model", "servo"), "preflight: expected a sequence of your own: electrohydrostatic servo"),
    (("late.toml",), "late.toml:14: faults[0].start: expected a time within main's 0.35 s, not 9")])
def test_bad_input_is_one_line(words: tuple[str, ...], line: str, tmp_path: Path) -> None:
    (tmp_path / "late.toml").write_text(f'{SHORT}faults = [{{ kind = "lost", frame = "drive", start = 9.0 }}]\n')
    assert line in refuse("check", *(tmp_path / word if word == "late.toml" else word for word in words))

"""Benches with another cycle: the sequence keeps its seconds, the plant its physics, the log its cycle."""

import shutil
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from rig_command import SHORT, job, play, refuse, rig, write_file

import dbc
from fdi.trace import Trace
from plant import Model, simulate
from rig.benches import load_bench
from rig.run import JobChoice, build_job
from rig.sequences import load_sequence, parse_sequence
from rig.suite.dry_run import make_dry_run
from rig.testing.bench import Bench

CYCLES = ("0.5", "2", "10")  # ms
GAIN = 0.25 * Model()["controller.proportional_gain"]  # with all of it the loop is unstable at 10 ms
PREFLIGHT = load_sequence("preflight")


def write_bench(folder: Path, cycle: str) -> str:
    """The shipped bench with another cycle, ms."""
    for path in dbc.EDS.values():
        shutil.copy(path, folder)
    text = files("rig.benches").joinpath("eha.toml").read_text(encoding="utf-8")
    (folder / "slow.toml").write_text(text.replace('cycle = "1 ms"', f'cycle = "{cycle} ms"'))
    return str(folder / "slow.toml")


@pytest.mark.parametrize("cycle", CYCLES)
def test_the_preflight_is_predicted_at_any_cycle(cycle: str, tmp_path: Path) -> None:
    """The same command at the same times; and what the checks measure depends on the sampling alone."""
    choice = JobChoice(changes={"controller.proportional_gain": GAIN}, bench=write_bench(tmp_path, cycle))
    dry, usual = make_dry_run(build_job(choice)), make_dry_run(build_job(choice._replace(bench=None)))
    assert dry.durations == usual.durations and dry.job.period_ns == round(1e6 * float(cycle))
    fine, coarse = sorted((dry.predicted, usual.predicted), key=lambda run: -len(run.t))
    same = [column[::round(len(fine.t) / len(coarse.t))] for column in (fine.com, fine.xj)]
    np.testing.assert_allclose(coarse.com, same[0], rtol=1e-9, atol=1e-12)
    assert float(np.sqrt(np.mean((coarse.xj - same[1]) ** 2))) < 0.1e-3 * max(1.0, float(cycle))
    for check, usual_check in zip(dry.checks, usual.checks, strict=True):
        assert (check.t0, check.t1, check.detail) == (usual_check.t0, usual_check.t1, usual_check.detail)
    values = {check.name: (check.value, usual_check.value)
              for check, usual_check in zip(dry.checks, usual.checks, strict=True)}
    for name, spread in (("gain, 1 Hz", 0.03), ("phase lag, 1 Hz", 1.0), ("rise time, 5 mm", 4.0 * float(cycle))):
        assert values[name][0] == pytest.approx(values[name][1], abs=spread), name


@pytest.mark.parametrize("cycle", CYCLES)
def test_a_run_is_that_of_the_simulation_at_any_cycle(cycle: str, tmp_path: Path) -> None:
    """But for the rounding of the frames. The log knows the cycle, and the run can be repeated from it."""
    bench = write_bench(tmp_path, cycle)
    short = write_file(tmp_path / "short.toml", SHORT)
    gain = f"controller.proportional_gain={GAIN!r}"
    result = rig("run", short, "--bench", bench, "--set", gain, "--json", "--out", tmp_path / "a")
    assert result.json["verdict"] == "PASS" and result.json["run"]["period"] == float(cycle) / 1e3
    trace, period = Trace.read(tmp_path / "a"), float(cycle) / 1e3
    assert trace.period == period and len(trace) == round(0.35 / period)
    sequence = parse_sequence(SHORT, "short.toml", lambda name: b"", 1 / period)
    command = np.concatenate((sequence.build_setup_profile().command, sequence.build_main_profile().command))
    model = Model().replace({"controller.period": period, "controller.proportional_gain": GAIN})
    assert float(np.abs(trace.xj - simulate(model, command).xj[round(0.05 / period):]).max()) < 20e-6
    result = rig("run", "--from", tmp_path / "a" / "trace.mcap", "--quiet", "--out", tmp_path / "b")
    assert result.status == 0, result
    again = Trace.read(tmp_path / "b")
    assert (again.xj == trace.xj).all() and again.period == period


def test_a_fault_between_two_cycles_begins_with_one_and_reactions_count_from_there(tmp_path: Path) -> None:
    text = SHORT.replace("checks = [", """
faults = [{ name = "gone", kind = "reset", start = 0.105 }]
checks = [
  { name = "off", kind = "shut_off", after = "gone", high = 0 },
  { name = "off after that time", kind = "shut_off", after = 0.105, high = 0 },""")
    text = 'ends = "safe_state"\n' + text.replace('event = "EMCY"', 'event = "never this"')
    outcome = play(job(text, bench=replace(load_bench(), cycle_ns=2_000_000)), tmp_path)
    assert [check.value for check in outcome.checks[:2]] == [0.0, 0.0], outcome.checks
    assert {event.t for event in outcome.events if event.text == "gone begins"} == {0.104}


def test_a_bench_in_a_test_has_its_own_cycle(tmp_path: Path) -> None:
    command = np.linspace(0.0, 1e-3, 60)
    run = Bench(tmp_path / "runs").run(command=command, bench=write_bench(tmp_path, "5"))
    assert run.trace.period == 5e-3 and (run.trace.com == np.rint(command * 1e7) / 1e7).all()


@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize(("old", "new", "message"), [
    ('"rest", kind = "hold", time = 0.05', '"rest", kind = "hold", time = 0.051',
     "odd.toml:5: main[0].time: expected whole cycles of 0.002 s, not 0.051"),
    ('kind = "hold", time = 0.05 },\n  { name = "step"',
     'kind = "sine", amplitude = 1e-3, frequency = 250, time = 0.05 },\n  { name = "step"',
     "odd.toml:5: main[0].frequency: expected a frequency below 250 Hz, not 250"),
    ("checks = [", 'checks = [ { name = "x", kind = "phase_lag", frequency = 300, high = 1 },',
     "checks[0].frequency: expected below half the rate of 500 Hz, not 300"),
    ("checks = [", 'faults = [{ kind = "jitter", start = 0.1, size = 2e-3 }]\nchecks = [',
     "faults[0].size: expected a time below a cycle, 0.002 s, not 0.002"),
    ("checks = [", 'timing = { sync = 3e-3 }\nchecks = [',
     "timing.sync: expected at most a cycle, 0.002 s, not 0.003")])
def test_what_such_cycles_cannot_show_is_refused(command: str, old: str, new: str, message: str, tmp_path: Path
                                                 ) -> None:
    sequence = write_file(tmp_path / "odd.toml", SHORT.replace(old, new, 1))
    assert message in refuse(command, sequence, "--bench", write_bench(tmp_path, "2"))


def test_the_period_of_the_model_is_the_cycle_of_the_bench(tmp_path: Path) -> None:
    bench = write_bench(tmp_path, "2")
    assert "expected 0.001 s, the cycle of 'EHA controller'" in refuse("run", "--set", "controller.period=0.002")
    assert "expected 0.002 s, the cycle of" in refuse("run", "--set", "controller.period=0.005", "--bench", bench)
    for changes in ({}, {"controller.period": 2e-3}):
        job = build_job(JobChoice(changes=changes, bench=bench))
        assert job.model["controller.period"] == 2e-3 and job.sequence.rate == 500.0
    assert build_job(JobChoice(), PREFLIGHT.at_rate(500.0)).sequence == PREFLIGHT

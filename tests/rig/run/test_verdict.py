"""No false green: a run without checks is not judged, limits and faults are reported, and so is what is not nominal."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rig_command import SHORT, job, play, rig, write_file

from fdi.diagnosis.diagnosis import diagnose
from fdi.report import build_run_report, format_report
from fdi.trace import Trace
from plant import load_model
from rig.benches import load_bench
from rig.run import LimitReached, Outcome, find_limits, run_job

UNCHECKED = SHORT.partition("checks = [")[0]
TO_THE_STOP = """
title = "To the stop"
main = [{ kind = "ramp", to = 0.05, time = 1.5 }, { kind = "hold", time = 0.1 }]
"""


def build_answer(outcome: Outcome) -> dict[str, object]:
    return json.loads((outcome.folder / "verdict.json").read_text())


def test_without_checks_nothing_passed(tmp_path: Path) -> None:
    outcome = play(job(UNCHECKED), tmp_path)
    assert (outcome.verdict, outcome.status, outcome.failures) == ("NOT_JUDGED", 0, [])
    assert outcome.why.startswith("the sequence has no checks; ")
    assert build_answer(outcome)["verdict"] == "NOT_JUDGED"
    report = build_run_report(Trace.read(tmp_path, all=True))
    assert (report.verdict, report.mood) == ("NOT_JUDGED", "doubtful") and "every check" not in report.sentence.lower()
    outcome = play(job(SHORT), tmp_path)
    cut_off = replace(outcome, limits=[LimitReached("", "xj", 0.04, 0.1, 0.2, "RPDO2")])
    assert (outcome.verdict, cut_off.verdict, cut_off.status) == ("PASS", "CANNOT_TELL", 1) and (
        "ram at the end of its range in frame RPDO2 (40 mm) for 200 ms" in cut_off.why)


def test_the_ram_at_its_stop_and_the_current_at_its_limit_are_reported(tmp_path: Path) -> None:
    outcome = play(job(TO_THE_STOP), tmp_path)
    limits = {limit.signal: limit for limit in outcome.limits}
    xj = Trace.read(tmp_path).xj
    first = int(np.argmax(xj > 0.04 - 10e-6))
    assert limits["xj"].limit == 0.04 and limits["xj"].t == pytest.approx(first * 1e-3, abs=2e-3)
    assert limits["xj"].seconds == pytest.approx(np.count_nonzero(xj > 0.04 - 10e-6) * 1e-3, abs=2e-3)
    assert limits["cor"].limit == 8e-3 and limits["cor"].seconds > 0.1
    text = format_report(build_run_report(Trace.read(tmp_path, all=True)))
    assert "limits reached: ram at its stop (40 mm)" in text and "current at its limit (8 mA)" in text
    assert [each["parameter"] for each in build_answer(outcome)["limits"]] == [  # type: ignore[attr-defined]
        "jack.travel", "spool.travel", "controller.current_limit"]


def test_a_signal_just_inside_its_limit_is_not_reported() -> None:
    model = load_model()
    columns = {"xj": np.array([0.0399, np.nan]), "xs": np.array([-1.24e-3, 0.0]), "cor": np.array([7.9999e-3, 0.0]),
               "p12": np.array([0.0, 2.0e10])}
    assert find_limits(columns.__getitem__, model, load_bench(), 0) == ()
    columns["cor"][1] = -8e-3
    columns["p12"][1] = -10.0 * 2**31
    assert [(limit.signal, limit.limit, limit.frame, limit.t, limit.seconds) for limit in find_limits(
        columns.__getitem__, model, load_bench(), 1)] == [
            ("cor", 8e-3, "", 0.0, 1e-3), ("p12", -10.0 * 2**31, "RPDO2", 0.0, 1e-3)]


STEPS = """
title = "Steps and a ramp"
setup = [{ kind = "hold", time = 0.1 }]
main = [
  { kind = "step", to = 5e-3, time = 0.4 }, { kind = "ramp", to = 3e-3, time = 0.6 },
  { kind = "step", to = 0.0, time = 0.4 },
]
checks = [{ name = "error", kind = "never_exceeds", signal = "xj", unit = "mm", high = 9.0 }]
"""


def diagnosis(verdict: str) -> dict[str, object]:
    return {"verdict": verdict, "sentence": f"The sentence of {verdict}."}


@pytest.mark.parametrize(("fdi_verdict", "verdict", "status"), [
    ("ACCEPTABLE", "PASS", 0), ("MAINTENANCE", "FAIL", 1), ("NON_NOMINAL", "FAIL", 1), ("SOMETHING_ELSE", "FAIL", 1),
    ("CANNOT_TELL", "PASS", 0)])
def test_a_fault_that_rig_fdi_finds_fails_the_run(fdi_verdict: str, verdict: str, status: int, tmp_path: Path) -> None:
    outcome = run_job(job(SHORT), tmp_path, lambda stage, share: None, lambda: False,
                      diagnose=lambda trace: diagnosis(fdi_verdict))
    assert (outcome.verdict, outcome.status) == (verdict, status) and build_answer(outcome)["verdict"] == verdict
    report = build_run_report(Trace.read(tmp_path, all=True))  # the log alone says so too
    assert report.verdict == verdict
    section = next(section for section in report.sections if section.title == "Faults found by rig fdi")
    assert section.items[0].text == f"The sentence of {fdi_verdict}."  # type: ignore[union-attr]
    assert (f"The sentence of {fdi_verdict}" in report.sentence) == (verdict == "FAIL")


def test_without_checks_only_an_acceptable_diagnosis_is_a_pass(tmp_path: Path) -> None:
    verdicts = [run_job(job(UNCHECKED), tmp_path, lambda stage, share: None, lambda: False,
                        diagnose=lambda trace, word=word: diagnosis(word)).verdict  # type: ignore[misc]
                for word in ("ACCEPTABLE", "CANNOT_TELL")]
    assert verdicts == ["PASS", "NOT_JUDGED"]


def test_a_clogged_filter_fails_a_run_with_fdi(tmp_path: Path) -> None:
    steps = write_file(tmp_path / "steps.toml", STEPS)
    answer = rig("run", steps, "--fdi", "--set", "filter.clogging=0.28", "--out", tmp_path / "run")
    assert answer.status == 1
    lines = answer.out.rstrip().splitlines()
    assert lines[1].startswith("FAIL  rig fdi: Filter clogging requires maintenance")
    assert lines[-1].split(maxsplit=1) == ["verdict", f"FAIL: {lines[1].removeprefix('FAIL  ')}"]
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Filter clogging requires maintenance" in page and "filter.clogging = 0.28" in page
    log = Trace.read(tmp_path / "run")
    assert diagnose(log).verdict == log.provenance["fdi.verdict"] == "MAINTENANCE"


def test_what_is_not_nominal_stands_everywhere(tmp_path: Path) -> None:
    sequence = write_file(tmp_path / "short.toml", SHORT + """
faults = [{ kind = "parameter", parameter = "filter.clogging", value = 0.1, start = 0.1 }]
""")
    out = tmp_path / "run"
    answer = rig("run", str(sequence), "--set", "null_bias.current=1e-5", "--set", "filter.law=linear", "--out",
                 str(out))
    text = ("filter.law = linear; null_bias.current = 1e-05 A; fault 'parameter filter.clogging' from 0.1 s")
    assert f"not nominal  {text}" in answer.out
    differences = json.loads((out / "verdict.json").read_text())["differences"]
    assert differences["text"] == text and differences["effects"] == ["null_bias"]
    assert differences["parameters"]["null_bias.current"] == 1e-5
    assert dict(build_run_report(Trace.read(out, all=True)).facts)["differs from nominal"] == text
    nominal = rig("run", str(sequence), "--out", str(out), "--json")
    assert nominal.json["differences"]["text"] == "fault 'parameter filter.clogging' from 0.1 s"

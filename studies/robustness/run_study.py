"""The whole study: fuzz frames and datagrams, disturbed runs, long operation."""

import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdi.progress import Progress, ignore_progress
from fdi.report.report import Cell, Column, Item, Line, Paragraph, Report, Section, Table
from plant.model import load_model
from rig.run.job import Job
from rig.run.runner import run_job
from rig.sequences.sequence import parse_sequence
from studies.robustness.datagrams import fuzz_datagrams
from studies.robustness.disturb import ACTIONS, PROCESSES, SEQUENCE, Trial, disturb_run
from studies.robustness.fuzz import fuzz_node, fuzz_rig
from studies.robustness.logs import LogCount, fuzz_logs
from studies.robustness.soak import soak_bench


def run_study(frames: int, trials: int, minutes: float, seed: int, controller: str,
              progress: Progress) -> dict[str, Any]:
    """Run the study; its figures, with all that went wrong as "problems".

    Args:
        frames: fuzz frames for each node; a tenth as many datagrams, a thousandth as many changed logs.
        trials: disturbed runs of each kind in which the disturbance came before the last cycle; at most twice as
            many are made.
        minutes: of long operation; 0 for none.
        seed: of frames and moments.
        controller: firmware of the disturbed runs and of the long operation, "builtin" or "c".
        progress: called with the stage and the share done.
    """
    problems: list[str] = []
    counts = [fuzz_node("plant", frames, seed, progress), fuzz_node("controller", frames, seed, progress),
              fuzz_rig(frames, seed, progress)] if frames else []
    most_growth = 16 << 20  # bytes of memory that fuzz frames may cost
    for count in counts:
        problems += [f"fuzz frames, {count.target}: {failure}" for failure in count.failures]
        if not count.works:
            problems.append(f"fuzz frames, {count.target}: does not work afterwards")
        if count.growth > most_growth:
            problems.append(f"fuzz frames, {count.target}: {count.growth >> 20} MiB more memory")
    datagrams = fuzz_datagrams(frames // 10, seed, _sample_group(seed, 1), controller, progress) if frames else None
    if datagrams and datagrams.verdict != "PASS":
        problems.append(f"fuzz datagrams: a run afterwards is {datagrams.verdict or 'impossible'}")
    problems += [f"fuzz datagrams: {problem}" for problem in (datagrams.problems if datagrams else ())]
    logs = _study_logs(frames // 1000, seed, progress) if frames >= 1000 else None
    problems += [f"changed logs: {failure}" for failure in (logs.failures if logs else ())]
    rows = []
    kinds = list(_list_kinds())
    for i, (action, victim) in enumerate(kinds):
        done: list[Trial] = []
        while trials and (effective := sum(one.is_effective for one in done)) < trials and len(done) < 2 * trials:
            progress(f"{action} {victim}", (i + effective / trials) / len(kinds))
            done.append(disturb_run(action, victim, seed + len(done), controller=controller))
        problems += [f"{action} {victim}, seed {seed + n}: {problem}" for n, one in enumerate(done)
                     for problem in one.problems]
        if done:
            rows.append(_summarise_trials(done))
    soak = soak_bench(minutes, _sample_group(seed, 2), controller=controller, progress=progress) if minutes else None
    if soak:
        problems += [f"long operation: {problem}" for problem in (*soak.problems, *soak.find_growth())]
    return {"frames": [count._asdict() for count in counts], "datagrams": datagrams._asdict() if datagrams else None,
            "logs": logs._asdict() if logs else None, "disturbed": rows,
            "soak": _describe_soak(soak._asdict()) if soak else None, "problems": problems}


def _study_logs(count: int, seed: int, progress: Progress) -> LogCount:
    """Changed logs of a short run on the embedded bus."""
    job = Job(sequence=parse_sequence(SEQUENCE.replace("time = 3.0", "time = 0.3"), "s.toml", lambda name: b""),
              model=load_model())
    with tempfile.TemporaryDirectory(prefix="eha-rig-study-") as place:
        run_job(job, Path(place) / "run", ignore_progress, lambda: False)
        return fuzz_logs(Path(place) / "run" / "trace.mcap", Path(place), count, seed, progress)


def _list_kinds() -> Iterator[tuple[str, str]]:
    """(action, victim) of all kinds of disturbance that this user can make."""
    for action in ACTIONS:
        if action in ("kill", "stop"):
            yield from ((action, victim) for victim in PROCESSES)
        elif action != "full tmpfs" or os.geteuid() == 0:  # mounting needs root
            yield action, "rig"


def _sample_group(seed: int, what: int) -> str:
    return "239." + ".".join(str(number) for number in np.random.default_rng([seed, what]).integers(1, 255, 3))


def _summarise_trials(trials: list[Trial]) -> dict[str, Any]:
    """One row of the table: counts over the trials of a kind."""
    ends = [trial.end for trial in trials]
    zeros = [trial.zero for trial in trials if trial.zero >= 0]
    statuses: dict[str, int] = {}
    for trial in trials:
        statuses[str(trial.status)] = statuses.get(str(trial.status), 0) + 1
    return {"action": trials[0].action, "victim": trials[0].victim, "trials": len(trials),
            "effective": sum(trial.is_effective for trial in trials),
            "sound": sum(not trial.problems for trial in trials), "statuses": statuses,
            "end_p50": float(np.median(ends)), "end_max": max(ends), "zero_max": max(zeros, default=None),
            "logs": sum(trial.cycles >= 0 for trial in trials)}


def _describe_soak(soak: dict[str, Any]) -> dict[str, Any]:
    usage = {when: {name: held._asdict() for name, held in soak[when].items()} for when in ("start", "end")}
    return {**soak, **usage}


def build_robustness_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `studies.robustness.run_study.run_study`, which are its `data`."""
    problems = figures["problems"]
    sentence = f"{len(problems)} problems." if problems else "Nothing hung, crashed, grew or was left behind."
    return Report(
        command="bench", title="robustness", verdict="FAIL" if problems else "PASS", mood="bad" if problems else "good",
        sentence=sentence,
        sections=[Section("Fuzz frames", _tabulate_frames(figures)),
                  Section("Disturbed runs", _tabulate_trials(figures)), Section("Long work", _tabulate_soak(figures)),
                  Section("Problems", [Paragraph(problem, "bad") for problem in problems[:50]])],
        data=dict(figures))


def _tabulate_frames(figures: Mapping[str, Any]) -> list[Item]:
    rows: list[list[Cell | str]] = []
    for count in figures["frames"]:
        rows.append([count["target"], str(count["frames"]), str(len(count["failures"])),
                     Cell("yes", "good") if count["works"] else Cell("NO", "bad"), f"{count['growth'] / 1e6:.1f}"])
    datagrams = figures["datagrams"]
    if datagrams:
        rows.append(["UDP, datagrams", str(datagrams["datagrams"]), str(len(datagrams["problems"])),
                     Cell("yes", "good") if datagrams["verdict"] == "PASS" else Cell("NO", "bad"),
                     f"{max(datagrams['growth'].values(), default=0) / 1e6:.1f}"])
    logs = figures["logs"]
    if logs:
        rows.append(["changed logs", str(logs["logs"]), str(len(logs["failures"])), "", ""])
    columns = [Column("into"), Column("frames", align="right"), Column("exceptions", align="right"),
               Column("works afterwards"), Column("more memory", "MB", "right")]
    return [Table(columns, rows, "Valid, mutated and random frames. Afterwards a node boots, answers SDO and takes "
                                 "part in a cycle; a run passes.")] if rows else []


def _tabulate_trials(figures: Mapping[str, Any]) -> list[Item]:
    rows: list[list[Cell | str]] = []
    for row in figures["disturbed"]:
        is_sound = row["sound"] == row["trials"]
        statuses = ", ".join(f"{count} x {status}" for status, count in sorted(row["statuses"].items()))
        rows.append([f"{row['action']} {row['victim']}", str(row["trials"]), str(row["effective"]),
                     Cell(str(row["sound"]), "good" if is_sound else "bad"), statuses, f"{row['end_p50']:.1f}",
                     f"{row['end_max']:.1f}", str(row["zero_max"]).replace("None", ""), str(row["logs"])])
    columns = [Column("disturbance"), Column("runs", align="right"), Column("effective", align="right"),
               Column("sound", align="right"),
               Column("exit status"), Column("end p50", "s", "right"), Column("end max", "s", "right"),
               Column("zero current max", "SYNCs", "right"), Column("logs read", align="right")]
    caption = ("End: from the disturbance to the end of the last process. Zero current: SYNCs from "
               "the last frame of the killed node. A run is sound if it ended in time with a documented status, its "
               "log could be read or recovered and nothing was left.")
    return [Table(columns, rows, caption)] if rows else []


def _tabulate_soak(figures: Mapping[str, Any]) -> list[Item]:
    soak = figures["soak"]
    if not soak:
        return []
    rows: list[list[Cell | str]] = []
    for name, before in soak["start"].items():
        after = soak["end"][name]
        rows.append([name, f"{before['memory'] / 1e6:.1f}", f"{after['memory'] / 1e6:.1f}",
                     f"{before['files']} -> {after['files']}", f"{before['threads']} -> {after['threads']}"])
    columns = [Column("process"), Column("memory at a tenth", "MB", "right"), Column("at the end", "MB", "right"),
               Column("open files"), Column("threads")]
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in soak["verdicts"].items())
    return [Table(columns, rows, "Run after run on nodes that stay."),
            Line("runs", f"{soak['runs']} in {soak['minutes']:g} minutes, {soak['cycles']} cycles: {verdicts}")]

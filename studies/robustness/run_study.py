"""The whole study: fuzz frames and datagrams, disturbed runs, long operation."""

import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from can import Message
from can.interfaces.udp_multicast.utils import pack_message

from fdi.progress import Progress, ignore_progress
from fdi.report import Cell, Column, Item, Line, Paragraph, Report, Section, Table
from plant import RigError, load_model
from rig.network import BusError, WallClock
from rig.network.udp import PORT, open_sockets
from rig.run import Job, run_job
from rig.sequences import parse_sequence
from studies.robustness.disturb import (
    ACTIONS,
    PROCESSES,
    SEQUENCE,
    Trial,
    Usage,
    disturb_run,
    find_processes,
    read_usage,
    start_nodes,
    wait_until,
)
from studies.robustness.fuzz import fuzz_node, fuzz_rig, invent_frames
from studies.robustness.logs import LogCount, fuzz_logs

_NESTED, _HUGE = b"\x91" * 2000, b"\xdd\xff\xff\xff\xff"  # msgpack: arrays in arrays; an array of 4 billion


class DatagramCount(NamedTuple):
    """What came of the datagrams."""

    datagrams: int
    verdict: str  # of a run on the same nodes afterwards
    growth: dict[str, int]  # bytes of memory, by process
    problems: tuple[str, ...]


def fuzz_datagrams(count: int, seed: int, group: str, controller: str = "builtin",
                   progress: Progress = ignore_progress) -> DatagramCount:
    """Send fuzz datagrams to the nodes of a UDP bus; afterwards a run on these nodes passes.

    A third are random bytes, a third frames with changed bytes, a third fuzz frames in proper datagrams.

    Raises:
        RigError: the nodes do not start.
    """
    rng, problems = np.random.default_rng(seed), []
    verdict, growth = "", {}
    with (tempfile.TemporaryDirectory(prefix="eha-rig-study-") as place,
          start_nodes(f"udp_multicast:{group}", controller) as nodes):
        own = {name: number for name, number in nodes.items() if name != "rig"}
        try:
            _play(group, Path(place))
            before = read_usage(own)
            with ExitStack() as stack:
                _, sender, _ = open_sockets(group, PORT, stack)
                for number, frame in enumerate(invent_frames(count, seed)):
                    message = Message(arbitration_id=frame.cob_id, data=frame.data, is_extended_id=False)
                    sender.sendto(_change(rng, pack_message(message)), (group, PORT))
                    if number % 1000 == 0:
                        progress("datagrams", number / count)
            verdict = _play(group, Path(place))
            after = read_usage(own)
            growth = {name: after[name].memory - before[name].memory for name in own}
        except (RigError, OSError) as error:  # OSError: a node has ended, its /proc entry is gone
            problems.append(f"{type(error).__name__}: {error}")
    return DatagramCount(count, verdict, growth, tuple(problems))


def _change(rng: np.random.Generator, datagram: bytes) -> bytes:
    kind = rng.random()
    if kind < 1.0 / 3.0:
        return datagram
    if kind < 2.0 / 3.0:
        mutant = bytearray(datagram)
        for _ in range(int(rng.integers(1, 6))):
            mutant[int(rng.integers(len(mutant)))] = int(rng.integers(256))
        return bytes(mutant[:int(rng.integers(len(mutant) + 1))] if rng.random() < 0.3 else mutant)
    if kind < 0.68:
        return (_NESTED, _HUGE)[int(rng.integers(2))] + rng.bytes(int(rng.integers(60_000)))
    return rng.bytes(int(rng.integers(100)))


def _play(group: str, folder: Path) -> str:
    job = Job(sequence=parse_sequence(SEQUENCE, "s.toml", lambda name: b""), model=load_model(),
              bus=f"udp_multicast:{group}", controller="external", plant="external")
    return run_job(job, folder / "run", ignore_progress, lambda: False).verdict


NO_ANSWER = "no answer"
SETTLE = 5.0  # s


class Soak(NamedTuple):
    """A soak: usage of each process after the first tenth of the time and at the end."""

    minutes: float
    runs: int
    cycles: int
    verdicts: dict[str, int]
    start: dict[str, Usage]
    end: dict[str, Usage]
    problems: tuple[str, ...]

    def find_growth(self, memory: int = 8 << 20) -> list[str]:
        """What has grown: memory by more than `memory` bytes, or any file or thread."""
        grown = []
        for name, before in self.start.items():
            after = self.end[name]
            for what, most in (("memory", memory), ("files", 0), ("threads", 0)):
                more = getattr(after, what) - getattr(before, what)
                if more > most:
                    grown.append(f"{name}: {what} +{more}")
        return grown


def soak_bench(minutes: float, group: str, pace: str = "lockstep", controller: str = "builtin",
               progress: Progress = ignore_progress) -> Soak:
    """Play a sequence of 3.2 s again and again on a UDP bus, with nodes that stay, for so many minutes.

    Raises:
        RigError: the nodes do not start.
    """
    clock = WallClock()
    sequence = parse_sequence(SEQUENCE, "soak.toml", lambda name: b"")
    bus = f"udp_multicast:{group}"
    job = Job(sequence=sequence, model=load_model(), bus=bus, pace=pace, controller="external", plant="external",
              max_overruns=1.0)
    verdicts: dict[str, int] = {}
    runs = cycles = 0
    start: dict[str, Usage] = {}
    problems = []
    with tempfile.TemporaryDirectory(prefix="eha-rig-soak-") as place, start_nodes(bus, controller) as nodes:
        while clock.now() < minutes * 60e9 or runs < 3:
            try:
                outcome = run_job(job, Path(place) / "run", ignore_progress, lambda: False)
                verdict, cycles = outcome.verdict, cycles + outcome.timing["cycles"]
            except BusError:  # a busy machine: the nodes did not answer in time
                verdict = NO_ANSWER
            runs, verdicts[verdict] = runs + 1, verdicts.get(verdict, 0) + 1
            if not start and runs >= 2 and clock.now() > minutes * 6e9:  # the first runs load what stays loaded
                start = read_usage(nodes)
            progress("soak", min(1.0, clock.now() / (minutes * 60e9)))

        def read_end() -> Soak:
            return Soak(minutes, runs, cycles, verdicts, start, read_usage(nodes), ())

        wait_until(lambda: not read_end().find_growth(), SETTLE)  # a thread of the last run may still be ending
        soak = read_end()
    if verdicts.get(NO_ANSWER, 0) > 0.1 * runs:
        problems.append(f"in {verdicts[NO_ANSWER]} of {runs} runs the nodes did not answer in time")
    if find_processes(group):
        problems.append("processes are left")
    return soak._replace(problems=tuple(problems))


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
    return {"action": trials[0].action, "victim": trials[0].victim, "trials": len(trials),
            "effective": sum(trial.is_effective for trial in trials),
            "sound": sum(not trial.problems for trial in trials),
            "statuses": dict(Counter(str(trial.status) for trial in trials)),
            "end_p50": float(np.median(ends)), "end_max": max(ends), "zero_max": max(zeros, default=None),
            "logs": sum(trial.cycles >= 0 for trial in trials)}


def _describe_soak(soak: dict[str, Any]) -> dict[str, Any]:
    usages = {when: {name: usage._asdict() for name, usage in soak[when].items()} for when in ("start", "end")}
    return {**soak, **usages}


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
    rows: list[list[Cell | str]] = [
        [count["target"], str(count["frames"]), str(len(count["failures"])),
         Cell("yes", "good") if count["works"] else Cell("NO", "bad"), f"{count['growth'] / 1e6:.1f}"]
        for count in figures["frames"]]
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

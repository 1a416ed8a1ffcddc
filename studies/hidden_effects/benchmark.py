"""The benchmark: a folder of cases with their truth, a scorer for everyone, and the answers of several methods.

    README.md  score.py  physics.md  benchmark.json  cases/CASE/{est,repeat,holdout}.csv.gz  truth/CASE.json

Answers are made case by case, and kept in answers-METHOD.jsonl beside the hash of the code that made them; there an
interrupted method resumes. answers-METHOD.json is for the scorer.
"""

import json
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fdi.report import format_duration
from fdi.sources import hash_sources, import_function
from fdi.trace import describe_section
from plant import RATE, InputError, Plant, RigError, find_plant, find_quantity, list_searched_effects, load_plant
from rig.campaign.batch import Batch, BatchProgress, Row, RowFile, Workers, run_batch, run_jobs
from rig.campaign.judge import FLOORS
from rig.network import WallClock
from studies.hidden_effects import any_plant, cases, truth
from studies.hidden_effects.command import preflight_command
from studies.hidden_effects.hidden import CATALOGUE

HERE = Path(__file__).parent
METHODS = {"explain": "rig_answer", "regression": "regression", "sindy": "sindy"}
"""Methods and the modules of this package with their `answer_case`."""
CASE_SOURCES = tuple(f"studies/hidden_effects/{name}" for name in ("truth.c", "truth.py", "command.py", "hidden.py",
                                                              "cases.py", "any_plant.py", "outside_ema.py"))
DRAWN = "drawn"  # signals that follow from the seed


def name_plant(name: str) -> Plant:
    """A shipped plant, or that of a file, which is loaded. Raises InputError."""
    return load_plant(Path(name)) if name.endswith(".py") else find_plant(name)


def make_benchmark(folder: Path, seeds: Sequence[int], signals: str | None = None, plant: str = "eha",
                   processes: int = 1, report_progress: Callable[[str], None] = lambda _: None,
                   small: bool = False) -> None:
    """Write the cases of `seeds` that the folder lacks, and what goes with them.

    Args:
        folder: made if it is missing.
        seeds: of the cases.
        signals: what is measured in every case, the first outputs of the plant; default: all; "drawn": by the seed.
        plant: shipped, or a plant file; the cases of the EHA are made by the simulator in C.
        processes: cases at a time.
        report_progress: gets a line for each case.
        small: hide one effect in each case of the EHA, one that others look like, at 1 to 2 noise floors.

    Raises:
        InputError: unknown signals or plant, no C compiler, or a folder that has other cases or cannot be written.
    """
    outputs = [s.name for s in name_plant(plant).signals.outputs]
    selections = [",".join(outputs[:count]) for count in range(1, len(outputs) + 1)]
    selection = signals or selections[-1]
    if selection not in (*selections, DRAWN):
        raise InputError("--signals", selection, " or ".join([*selections, DRAWN]))
    if plant == "eha":
        truth.parameter_names()  # compile the simulator before several processes need it
    _write_description(folder, {"plant": plant, "signals": selection, "small": small,
                                "made_by": hash_sources(*CASE_SOURCES)})
    missing = [seed for seed in seeds if not (folder / "cases" / f"{seed:05d}").exists()]
    clock, work = WallClock(), partial(make_case, folder=folder, signals=selection, plant=plant, small=small)
    for done, (seed, _) in enumerate(run_jobs(work, missing, Workers(processes), _raise_failure), start=1):
        seconds_left = clock.now() * 1e-9 / done * (len(missing) - done)
        report_progress(f"case {seed:05d} made, {done}/{len(missing)}, {format_duration(seconds_left)} left")


def _raise_failure(seed: int, reason: str) -> None:
    raise RigError(f"case {seed:05d} could not be made: {reason}")


def _write_description(folder: Path, settings: dict[str, Any]) -> None:
    """Write benchmark.json and the files that do not depend on the cases. Raises InputError for another benchmark."""
    file = folder / "benchmark.json"
    if file.exists() and not settings.items() <= read_description(folder).items():
        raise InputError(folder, "", "an empty folder, or one with cases of the same plant, signals and simulator")
    try:
        (folder / "truth").mkdir(parents=True, exist_ok=True)
        for source in (HERE / "README.md", HERE / "score.py", HERE.parent.parent / "docs" / "physics.md"):
            shutil.copyfile(source, folder / source.name)
        description = settings | (_describe_eha() if settings["plant"] == "eha" else {})
        file.write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(folder, "", f"a folder that can be written ({error.strerror})") from None


def _describe_eha() -> dict[str, Any]:
    """What a method may know: sections of the command, the nominal parameters, and the catalogue with its sizes."""
    kind, command = find_plant("eha"), preflight_command()
    laws = {e.name: e for e in list_searched_effects("eha") if e.name in CATALOGUE}
    return {
        "noise_floors": {s.name: [FLOORS[s.name], s.unit] for s in kind.signals.outputs},
        "sections": {name: {"start": s.start / RATE, "stop": s.stop / RATE, "command": describe_section(
            s, float(abs(command[s.start:s.stop]).max()))} for name, s in cases.name_sections(command).items()},
        "nominal": {name: [value, find_quantity(name).unit] for name, value in kind.nominal.items()
                    if name.partition(".")[0] in kind.parameters and isinstance(value, float)},
        "catalogue": {name: {"parameter": e.fitted[0], "unit": e.parameters[e.fitted[0]].unit, "law": e.law,
                             "meaning": e.symptoms} for name, e in laws.items()}}


def read_description(folder: Path) -> dict[str, Any]:
    """The benchmark.json of a folder. Raises InputError where there is none."""
    try:
        description: dict[str, Any] = json.loads((folder / "benchmark.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(folder, "", "the folder of a benchmark, which --benchmark without --answer makes") from None
    return description


def make_case(seed: int, folder: Path, signals: str, plant: str, small: bool = False) -> None:
    """Write the traces and the truth of a seed."""
    target = folder / "cases" / f"{seed:05d}"
    part = target.with_name(target.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    if plant == "eha":
        sample = cases.sample_small_case if small else cases.sample_case
        cases.write_case(sample(seed, signals=None if signals == DRAWN else signals), part)
    else:
        name_plant(plant)
        case = any_plant.sample_case(plant, seed)
        any_plant.write_case(plant, case if signals == DRAWN else case._replace(signals=signals), part)
    (part / "truth.json").replace(folder / "truth" / f"{target.name}.json")
    part.rename(target)


def answer_benchmark(folder: Path, method: str, processes: int = 1,
                     report_progress: Callable[[BatchProgress], None] = lambda _: None) -> Path:
    """The file with the answers of a method to all cases; cases with an answer by the same code are not done again.

    Args:
        folder: of the benchmark.
        method: one of METHODS, or the `module:function` of another one (case folder, plant, signals -> answer).
        processes: cases at a time.
        report_progress: called after each finished case.

    Raises:
        InputError: no benchmark, no such method, or it needs a package that is not installed.
    """
    plant = read_description(folder)["plant"]
    module = METHODS.get(method)
    name = f"studies.hidden_effects.{module}:answer_case" if module else method
    import_function(name, "--answer", "a method")
    more = (f"studies/hidden_effects/{module}.py",) if module else ()
    sources = hash_sources("plant", "fdi", *CASE_SOURCES, *more)

    def describe_failure(case: str, reason: str) -> Row:
        return make_row(case, sources, {"verdict": "failed", "error": reason})

    batch = Batch(jobs={int(case.name): case.name for case in sorted((folder / "cases").glob("*[0-9]"))},
                  work=partial(answer_case, folder=folder, name=name, plant=plant, sources=sources), key="case",
                  describe_failure=describe_failure, is_valid=lambda row: bool(row["sources"] == sources),
                  is_failed=lambda row: bool(row["answer"]["verdict"] == "failed"))
    stem = f"answers-{method.replace(':', '-')}"
    with RowFile(folder / f"{stem}.jsonl") as file:
        rows = run_batch(batch, file, Workers(processes), report_progress)
    answers = {"method": method, "answers": {f"{number:05d}": row["answer"] for number, row in rows.items()}}
    (folder / f"{stem}.json").write_text(json.dumps(answers, indent=1) + "\n", encoding="utf-8")
    return folder / f"{stem}.json"


def answer_case(case: str, folder: Path, name: str, plant: str, sources: str) -> Row:
    """The row of a case: the answer of the method `name` with its time. A crash is an answer as well."""
    name_plant(plant)
    signals = json.loads((folder / "truth" / f"{case}.json").read_text(encoding="utf-8"))["signals"]
    clock = WallClock()
    start = clock.now()
    try:
        answer = import_function(name, "--answer", "a method")(folder / "cases" / case, plant, signals)
    except Exception as error:
        answer = {"verdict": "failed", "error": f"{type(error).__name__}: {error}"}
    return make_row(case, sources, answer | {"seconds": (clock.now() - start) * 1e-9})


def make_row(case: str, sources: str, answer: dict[str, Any]) -> Row:
    """A line of answers-METHOD.jsonl."""
    return {"case": int(case), "sources": sources, "answer": answer}


def describe_progress(progress: BatchProgress) -> str:
    """One finished case in one line, and the time left."""
    answer = progress.row["answer"]
    names = ", ".join(answer.get("effects") or []) or answer.get("error", "")
    return (f"{progress.done}/{progress.total}, {format_duration(progress.left)} left: "
            f"case {progress.row['case']:05d}, {answer['verdict']} {names}, {answer.get('seconds', 0.0):.1f} s")

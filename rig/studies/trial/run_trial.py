"""The blind trial's cases through an explanation, in several processes, to be taken up again where it was left.

Each finished case is one line of results.jsonl. A line counts only for the sources it was made with.
"""
from __future__ import annotations

import contextlib
import json
import shutil
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from fdi.sources import digest, named
from plant.errors import InputError
from rig.network.clock import WallClock
from rig.studies.trial import cases, truth

Explain = Callable[[Path, Path, Sequence[Path], Sequence[str]], dict[str, Any]]
"""est, holdout, repeats, signals -> the JSON of `rig explain`."""

RESULTS = "results.jsonl"
# what makes a case
TRIAL = tuple(f"rig/studies/trial/{name}" for name in ("truth.c", "truth.py", "command.py", "hidden.py", "cases.py"))
KEPT = 5  # candidates kept of an answer


class Progress(NamedTuple):
    """How far a trial is."""

    done: int
    total: int
    left: float  # s, about
    record: dict[str, Any]  # of the case just done


def load_explain(name: str) -> Explain:
    """The callable that "module:function" names.

    Raises:
        InputError: there is no such thing.
    """
    return named(name, "the blind trial", "an explanation")


def run(explain: str, seeds: Sequence[int], folder: Path, jobs: int = 2,
        progress: Callable[[Progress], None] = lambda _: None) -> list[dict[str, Any]]:
    """The records of the cases of `seeds`, in their order; what `folder` has already is not done again.

    `explain` names the callable as "module:function", for the processes to import.

    Raises:
        InputError: no such callable, no C compiler, or no such folder can be made.
    """
    load_explain(explain)
    truth.fields()  # built once, before the processes need it
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(folder, "", f"a folder that can be made ({error.strerror})") from error
    known = {r["seed"]: r for r in _lines(folder / RESULTS) if r["sources"] == sources() and r["by"] == explain}
    found = {seed: known[seed] for seed in seeds if seed in known}
    missing = [seed for seed in seeds if seed not in found]
    clock = WallClock()
    start = clock.now()
    with (folder / RESULTS).open("a", encoding="utf-8") as out:
        for record in _each(explain, missing, folder, jobs):
            found[record["seed"]] = record
            out.write(json.dumps(record) + "\n")
            out.flush()
            fresh = len(found) - (len(seeds) - len(missing))
            left = (clock.now() - start) * 1e-9 / fresh * (len(missing) - fresh)
            progress(Progress(len(found), len(seeds), left, record))
    return [found[seed] for seed in seeds]


def _each(explain: str, seeds: Sequence[int], folder: Path, jobs: int) -> Iterator[dict[str, Any]]:
    """Records as they come. Processes are spawned, because a fork of a process with threads may hang."""
    if jobs < 2 or len(seeds) < 2:
        yield from (one(explain, seed, folder) for seed in seeds)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        waiting: set[Future[dict[str, Any]]] = {pool.submit(one, explain, seed, folder) for seed in seeds}
        try:
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        finally:
            pool.shutdown(cancel_futures=True)


def one(explain: str, seed: int, folder: Path) -> dict[str, Any]:
    """One case explained: its truth, the answer in short, and how long it took. A crash is an answer, too."""
    case = prepared(seed, folder)
    hidden = tomllib.loads((case / "truth.toml").read_text(encoding="utf-8"))
    clock = WallClock()
    start = clock.now()
    try:
        answer = _short(load_explain(explain)(case / "est.csv.gz", case / "holdout.csv.gz", [case / "repeat.csv.gz"],
                                              hidden["signals"].split(",")))
    except Exception as error:
        answer = {"verdict": "CRASHED", "effects": [], "error": f"{type(error).__name__}: {error}"}
    return {"seed": seed, "by": explain, "sources": sources(), "truth": hidden, "answer": answer,
            "seconds": (clock.now() - start) * 1e-9}


def prepared(seed: int, folder: Path) -> Path:
    """The folder with the case of a seed, made if it is not there."""
    target = folder / f"cases-{digest(*TRIAL)[:8]}" / f"{seed:05d}"
    if not target.exists():
        part = target.with_name(target.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        cases.write(cases.draw(seed), part)
        part.rename(target)  # whole or not at all
    return target


def _short(answer: dict[str, Any]) -> dict[str, Any]:
    """What scoring needs of an answer."""
    kept = {key: answer.get(key) for key in ("verdict", "effects", "baseline", "pattern")}
    candidates = answer.get("candidates", [])
    named = set(answer["effects"])
    return kept | {"candidates": [c for i, c in enumerate(candidates) if i < KEPT or c["effect"] in named]}


def _lines(path: Path) -> list[dict[str, Any]]:
    """The records in a file; a line that was cut is left out, and ended."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    if text and not text.endswith("\n"):
        with path.open("a", encoding="utf-8") as out:
            out.write("\n")
    found = []
    for line in text.splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            found.append(json.loads(line))
    return found


def sources() -> str:
    """A hash of all that an answer depends on."""
    return digest("plant", "fdi", *TRIAL)

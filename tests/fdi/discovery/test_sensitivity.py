"""`rig explain --sensitivity`: what is hidden, in which unit, with which noise, and what is claimed after how many."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from effect_files import SEARCHED, restored_catalogue
from rig_command import refuse, rig
from short_runs import HIDDEN, list_trace_arguments, write_measured_runs

import rig.campaign.sensitivity as rounds
from fdi.discovery.explain_runs import Answer, explain_runs
from fdi.discovery.runs import Runs, read_runs
from fdi.discovery.sensitivity import (
    NEEDED,
    RUNGS,
    TRIALS,
    Injection,
    Unit,
    choose_injections,
    describe_unit,
    hide_effect,
    judge_injection,
    measure_size,
    summarise_injections,
)
from plant import InputError, load_model

Row = dict[str, Any]


@pytest.fixture(scope="module", autouse=True)
def few_effects() -> Iterator[None]:
    with restored_catalogue(*SEARCHED):
        yield


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("runs"), HIDDEN)


@pytest.fixture(scope="module")
def explained(files: dict[str, Path]) -> tuple[Runs, Answer]:
    words = [str(word) for word in list_trace_arguments(files)]
    runs = read_runs(load_model("eha"), words[0], [words[2]], words[4])
    return runs, explain_runs(runs)[0]


@pytest.fixture
def unit(explained: tuple[Runs, Answer]) -> Unit:
    return describe_unit(*explained)


def test_the_unit_is_the_measured_one_and_its_model_has_what_was_found(unit: Unit) -> None:
    assert unit.model.effects == ("null_bias",) and "null_bias" not in unit.effects
    assert unit.model["null_bias.current"] == pytest.approx(HIDDEN["null_bias.current"], rel=0.1)
    assert unit.values["null_bias.current"] == unit.model["null_bias.current"]
    assert set(unit.noise) == {"xj", "p12", "xs"} and unit.repeats == 1 and unit.holdout is not None


def test_the_same_injection_makes_the_same_runs_and_a_larger_one_moves_them_more(unit: Unit) -> None:
    once, again, smaller = (hide_effect(unit, Injection(3, "constant_load", rung, 0)).est for rung in (0, 0, 3))
    assert all((once.column(name) == again.column(name)).all() for name in unit.noise)
    plain = hide_effect(unit, Injection(3, "constant_load", RUNGS + 20, 0)).est
    large, small = (np.abs(run.drive - plain.drive).mean() for run in (once, smaller))
    assert large > 3.0 * small > 0.0
    sizes = [measure_size(unit.model, "constant_load", rung) for rung in (0, 3)]
    assert sizes[0] == pytest.approx(8.0 * sizes[1])


def test_a_large_effect_is_named_as_in_a_measured_run(unit: Unit) -> None:
    row = judge_injection(Injection(5, "constant_load", 1, 0), unit)
    assert (row["verdict"], row["effects"], row["is_named"]) == ("EXPLAINED", ["constant_load"], True)


def play_rounds(unit: Unit, first: int, is_named: Callable[[Injection], bool]) -> list[Row]:
    rows: list[Row] = []
    while jobs := choose_injections(unit, dict.fromkeys(unit.effects, first), rows):
        assert {job.number for job in jobs}.isdisjoint(row["number"] for row in rows)
        rows += [answer(job, is_named(job)) for job in jobs]
    return rows


def answer(job: Injection, is_named: bool) -> Row:
    return {**job._asdict(), "is_named": is_named, "verdict": "EXPLAINED" if is_named else "AMBIGUOUS",
            "effects": [job.effect] if is_named else [job.effect, "sensor_gain"]}


@pytest.mark.parametrize("first", [0, 3, RUNGS - 1])
@pytest.mark.parametrize("last", [-1, 0, 2, 5, RUNGS - 1])
def test_the_smallest_size_that_is_named_is_found_from_anywhere(unit: Unit, first: int, last: int) -> None:
    """`last`: the smallest rung on which an effect is named; -1: on none."""
    one = Unit(**{**vars(unit), "effects": ("constant_load", "coil_lag")})
    rows = play_rounds(one, first, lambda job: job.rung <= last)
    for claim in summarise_injections(one, rows):
        expected = None if last < 0 else measure_size(unit.model, claim.effect, last)
        assert claim.smallest == expected
        assert claim.named is None if last < 0 else claim.named and (claim.named.good, claim.named.of) == (10, 10)
        misses = sum(row["effect"] == claim.effect and not row["is_named"] for row in rows)
        assert dict(claim.taken_for) == ({f"{claim.effect} and sensor_gain (AMBIGUOUS)": misses} if misses else {})
    assert len(rows) <= len(one.effects) * TRIALS * (abs(first - last) + 2)


def test_a_size_counts_with_one_miss_and_not_with_two(unit: Unit) -> None:
    one = Unit(**{**vars(unit), "effects": ("coil_lag",)})
    for misses in (TRIALS - NEEDED, TRIALS - NEEDED + 1):
        rows = play_rounds(one, 0, lambda job: job.rung == 0 and job.trial >= misses)  # noqa: B023 - called at once
        (claim,) = summarise_injections(one, rows)
        assert (claim.smallest is not None) == (misses <= TRIALS - NEEDED)


def test_the_command_tells_claims_and_resumes(files: dict[str, Path], monkeypatch: pytest.MonkeyPatch,
                                              tmp_path: Path) -> None:
    made: list[Injection] = []

    def judge(job: Injection, unit: Unit) -> Row:
        made.append(job)
        return answer(job, job.rung <= 2)

    monkeypatch.setattr(rounds, "judge_injection", judge)
    arguments = ("explain", *list_trace_arguments(files), "--sensitivity", "--hide", "coil_lag,constant_load",
                 "--workers", "1", "--out", tmp_path / "page.html")
    said = rig(*arguments, "--json")
    claims = {claim["effect"]: claim for claim in said.json["sensitivity"]}
    assert set(claims) == {"coil_lag", "constant_load"} and made
    lag = claims["coil_lag"]
    assert lag["parameter"] == "coil_lag.time" and lag["unit"] == "s" and lag["named"]["good"] == TRIALS
    assert lag["smallest_named"] == max(c["size"] for c in lag["counts"] if c["of"] == TRIALS and c["named"] == TRIALS
                                        and c["size"] <= lag["smallest_named"])
    page = (tmp_path / "page.html").read_text()
    assert "Sizes that are named" in page and "coil_lag and sensor_gain (AMBIGUOUS)" in page
    made.clear()
    assert "Each effect was hidden in this unit" in rig(*arguments).out and made == []


@pytest.mark.parametrize("words, expected", [
    (("--sensitivity", "--hide", "coil_log"), "coil_lag"), (("--sensitivity", "--workers", "0"), "1 or more processes"),
    (("--hide", "coil_lag"), "--sensitivity beside it"), (("--workers", "2"), "--sensitivity beside it")])
def test_options_that_mean_nothing_are_refused_before_the_search(files: dict[str, Path], words: tuple[str, ...],
                                                                 expected: str) -> None:
    assert expected in refuse("explain", *list_trace_arguments(files), *words)


def test_nothing_is_claimed_of_a_unit_that_no_model_explains(explained: tuple[Runs, Answer]) -> None:
    runs, found = explained
    e = found.explanation
    worse = replace(e.base, ratio=dict.fromkeys(e.base.ratio, 5.0))
    unexplained = replace(found, explanation=replace(e, verdict="UNEXPLAINED", base=worse, ledger=(worse,)))
    with pytest.raises(InputError, match="more than noise is left"):
        describe_unit(runs, unexplained)

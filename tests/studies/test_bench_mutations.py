"""A few of the damaged bench files, data sheets and DBCs of `studies.bench_mutations`."""

from collections import Counter

from studies.bench_mutations import run_trials


def test_damaged_files_are_refused_in_one_line_or_make_a_bench() -> None:
    kinds: Counter[str] = Counter()
    for number, _, outcome in run_trials(150, 2):
        assert outcome.kind != "failed", f"trial {number}: {outcome.text}"
        kinds[outcome.kind] += 1
    assert min(kinds["loaded"], kinds["refused"]) > 10

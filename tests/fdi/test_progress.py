"""Bars move: a stage takes its steps from any thread, and the long stage of a diagnosis shows its rounds."""
from __future__ import annotations

import numpy as np
from short_runs import build_command

from fdi.diagnosis.diagnosis import diagnose
from fdi.progress import Stage
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.threads import map_in_threads


def test_a_stage_goes_from_its_begin_to_its_end_and_no_further() -> None:
    seen: list[tuple[str, float]] = []
    stage = Stage(lambda name, share: seen.append((name, share)), "fits", 0.2, 0.6, 4)
    map_in_threads(lambda _: stage.finish_step(), range(6), 3)
    assert {name for name, _ in seen} == {"fits"} and seen[0][1] == 0.2
    assert np.allclose(sorted(share for _, share in seen), [0.2, 0.3, 0.4, 0.5, 0.6, 0.6, 0.6])


def test_the_bar_of_a_diagnosis_moves_within_its_long_stage() -> None:
    columns = simulate(Model().replace({"filter.clogging": 0.2}), build_command(), None, 1, 50)
    seen: list[tuple[str, float]] = []
    diagnose(Trace.from_columns(columns._asdict(), 1e-3, {}), workers=1,
             progress=lambda name, share: seen.append((name, share)))
    shares = [share for _, share in seen]
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert len({share for name, share in seen if name == "refinement"}) > 8

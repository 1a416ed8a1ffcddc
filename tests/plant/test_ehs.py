"""The second plant, a pump that drives a ram: what its law says, and what real measurements make of it."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import SHARED
from rig_command import rig

from plant import load_model
from plant.lanes import Lanes

DATA = SHARED / "data" / "electrohydrostatic_rig"
real = pytest.mark.skipif(not DATA.is_dir(), reason=f"no measurements at {DATA.name}: they belong to others")


def speeds(**changed: float) -> tuple[float, float]:
    """The ram's speed forwards at 1000 units of motor speed, and backwards, m/s."""
    names = [name.replace("__", ".") for name in changed]
    lanes = Lanes(load_model("ehs").replace({"quantisation.lsb": 0.0}), names)
    driven = np.r_[np.full(300, 1000.0), np.full(400, -1000.0)]
    xj = lanes.replay(np.array([[*changed.values()]]), driven, np.zeros(700))[0, :, 0]
    return (xj[290] - xj[190]) / 0.1, (xj[690] - xj[590]) / 0.1


def test_nominal_is_an_integrator() -> None:
    """XJ' = D w / AJ, both ways."""
    model = load_model("ehs")
    speed = model["pump.displacement"] * 1000.0 / model["jack.area"]
    assert speeds(pump__area_ratio=1.0) == pytest.approx((speed, -speed), rel=1e-6)


def test_unequal_areas_make_it_faster_backwards() -> None:
    forwards, backwards = speeds(pump__area_ratio=0.68)
    assert -forwards / backwards == pytest.approx(0.68, rel=1e-6)


def test_the_bench_refuses_it() -> None:
    said = rig("run", "--model", "ehs")
    assert said.status == 2 and "a model of eha" in said.err and len(said.err.splitlines()) == 1


@real
def test_the_bare_integrator_is_incomplete() -> None:
    said = rig("compare", DATA / "exp_data_3_4.csv.gz", "--model", "ehs", "--json")
    assert said.status == 1 and said.json["verdict"] == "MODEL_INCOMPLETE"
    assert said.json["signals"]["xj"]["ratio"] > 5.0


@real
def test_the_error_falls_on_runs_that_no_fit_saw(tmp_path: Path) -> None:
    """Fitted to 3_4 alone; the ratio of areas is what 750 against 1100 units for the same speed say, 0.68."""
    said = rig("add", "one_way_load", "unequal_areas", DATA / "exp_data_3_4.csv.gz", "--model", "ehs", "--holdout",
               DATA / "exp_data_2_2.csv.gz", "--out", tmp_path / "rig.toml", "--json")
    assert said.status == 0, said.err
    first, *_, last = said.json["ledger"]
    for run in ("error", "holdout"):
        assert last[run]["p12"] < 0.6 * first[run]["p12"] and last[run]["xj"] <= first[run]["xj"]
    ratio = said.json["parameters"]["pump.area_ratio"]
    assert ratio["low"] < ratio["value"] < ratio["high"] and ratio["value"] == pytest.approx(0.68, abs=0.03)

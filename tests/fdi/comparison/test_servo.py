"""The shipped model of a real servo on its recordings: what it promises on runs that no fit saw."""
from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
from places import SHARED
from rig_command import rig

from fdi.estimation.replay import compute_residuals, prepare_trace, replay_command, replay_current
from fdi.trace.trace import Trace, rms
from plant import load_model

DATA = SHARED / "data" / "electrohydrostatic_rig_raw"
real = pytest.mark.skipif(not DATA.is_dir(), reason=f"no measurements at {DATA.name}: they belong to others")
STEPS = 10  # a cycle


@cache
def read_run(run: str) -> Trace:
    """The prepared recording."""
    return prepare_trace(Trace.read(DATA / f"exp_data_{run}.csv.gz"), load_model("ehs"))


def measure_errors(model: str, run: str, is_driven: bool = True) -> dict[str, float]:
    """RMS residual of XJ and P12, SI; not driven: from the motor's speed alone."""
    trace = read_run(run) if is_driven else replace(read_run(run), chambers=None)
    found = compute_residuals(trace, replay_current(trace, load_model(model), STEPS))
    return {name: rms(values) for name, values in found.items()}


@real
@pytest.mark.parametrize(("run", "position", "pressure"), [
    ("3_4", 0.40, 0.2), ("1_1", 0.50, 0.4), ("1_4", 0.42, 0.4), ("2_2", 0.42, 0.3), ("4_3", 0.42, 0.2)])
def test_the_error_beside_that_of_the_bare_integrator(run: str, position: float, pressure: float) -> None:
    """Fitted to 3_4 alone; the other runs were never fitted."""
    bare, servo = measure_errors("ehs", run), measure_errors("servo", run)
    assert servo["xj"] < position * bare["xj"]
    assert servo["p12"] < pressure * bare["p12"]


@real
def test_no_signal_is_predicted_from_itself() -> None:
    """P12 does not use the measured pressures; XJ from the motor's speed alone is worse."""
    driven, alone = measure_errors("servo", "2_2"), measure_errors("servo", "2_2", is_driven=False)
    assert driven["p12"] == alone["p12"]
    assert alone["xj"] > 1.1 * driven["xj"]
    assert alone["xj"] < 0.8 * measure_errors("ehs", "2_2", is_driven=False)["xj"]


@real
def test_compare_finds_the_shipped_model_by_its_name() -> None:
    """Its error does not depend on the steps of a cycle; that from the command alone falls as well."""
    found = rig("compare", DATA / "exp_data_1_1.csv.gz", "--model", "servo", "--json").json["signals"]
    assert found["xj"]["error"] == pytest.approx(measure_errors("servo", "1_1")["xj"], rel=0.03)
    bare = replay_command(read_run("1_1"), load_model("ehs"), STEPS)
    assert found["xj"]["closed_loop_error"] < 0.8 * rms(bare["xj"])


def test_the_shipped_model_says_where_it_comes_from() -> None:
    model = load_model("servo")
    assert model.plant == "ehs" and model.name == "servo"
    assert {"undissolved_air", "flow_delay", "one_way_load"} <= set(model.effects)

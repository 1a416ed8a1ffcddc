"""`rig compare` on recordings of another simulator and of a real servo: right where the truth is known."""

from dataclasses import replace
from functools import cache

import pytest
from places import SHARED
from rig_command import rig

from fdi.comparison.compare import Comparison, compare
from fdi.estimation.replay import compute_residuals, prepare_trace, replay_command, replay_current
from fdi.report.compare_report import describe_verdict
from fdi.trace.trace import Trace, rms
from plant import Model, load_model

FOLDER = SHARED / "practice"
RIG = FOLDER.parent / "data/electrohydrostatic_rig"
pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="no ../shared: no traces of an independent simulator")

TRUE: dict[str, dict[str, float]] = {  # without plant scatter: a friction, two faults together
    "00": {"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0},
    "10": {"spool.static_friction": 33.0, "spool.dynamic_friction": 22.0, "filter.clogging": 0.21},
}
LEVELS = {"xj": 2e-6, "p12": 2e4, "xs": 1e-6}
BLOCK = {"01": "servovalve", "04": "jack", "05": "sensor", "06": "jack", "07": "servovalve"}


@cache
def trace(case: str, name: str) -> Trace:
    return Trace.read(FOLDER / case / f"{name}.csv.gz")


@cache
def nominal(case: str) -> Comparison:
    return compare(trace(case, "est"), Model(), [trace(case, "repeat")])


@pytest.mark.parametrize("case", TRUE)
def test_the_truth_is_at_the_floor(case: str) -> None:
    for name, repeats in (("est", [trace(case, "repeat")]), ("holdout", [])):
        found = compare(trace(case, name), Model().replace(TRUE[case]), repeats)
        assert found.verdict == "WITHIN_FLOOR", describe_verdict(found)
        for signal in found.signals.values():
            noise = signal.floor.value / LEVELS[signal.signal.name]
            assert (signal.ratio, noise) == pytest.approx((1.0, 1.0), abs=0.03)


@pytest.mark.parametrize("case", BLOCK)
def test_the_nominal_model_lacks_something_in_the_right_block(case: str) -> None:
    found = nominal(case)
    assert found.verdict == "MODEL_INCOMPLETE" and found.named[0] == BLOCK[case], describe_verdict(found)
    assert found.scatter is not None and not found.scatter.enough and found.answer.ratio < 1.0


@pytest.mark.parametrize("case", sorted([*BLOCK, "08"]))
def test_the_floor_is_the_sensors_noise_however_wrong_the_model(case: str) -> None:
    """Also where it is coloured with hum of one phase, and stick-slip differs between the repeats by 30 floors."""
    for signal in nominal(case).signals.values():
        assert signal.floor.value == pytest.approx(LEVELS[signal.signal.name], rel=0.15)


def test_plant_scatter_alone_is_said_to_be_possible() -> None:
    """08 lacks nothing, but its plant is 1.5 % off the nominal one here and there."""
    found = nominal("08")
    assert found.verdict == "MODEL_INCOMPLETE" and found.scatter is not None and found.scatter.enough
    assert max(abs(moved) for moved in found.scatter.moved.values()) < 3.0


@pytest.mark.parametrize(("case", "words"), [("05", "after a reversal"), ("06", "further than 2 mm from the middle"),
                                             ("07", "accelerates by more than")])
def test_conditions_in_words(case: str, words: str) -> None:
    assert words in nominal(case).condition


@pytest.mark.skipif(not RIG.exists(), reason="no ../shared/data: no measurements of another actuator")
def test_measurements_of_another_plant() -> None:
    """No balances and no known firmware there: the plant is one block."""
    found = compare(Trace.read(RIG / "exp_data_1_1.csv.gz"), load_model("ehs"))
    worst = max(signal.ratio for signal in found.signals.values())
    assert found.verdict == "MODEL_INCOMPLETE" and found.named == ("plant",)
    assert found.blocks == {"controller": None, "plant": worst, "sensors": None}
    assert found.signals["xj"].floor.value == pytest.approx(2.5e-5 / 12**0.5, rel=0.05)  # rounding to a count
    assert "the model does not explain" in describe_verdict(found).lower() and len(found.where) > 3


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
    ("3_4", 0.40, 0.2), ("1_1", 0.50, 0.4), ("2_2", 0.42, 0.3)])
def test_the_error_beside_that_of_the_bare_integrator(run: str, position: float, pressure: float) -> None:
    """Fitted to 3_4 alone; the other runs were never fitted."""
    bare, servo = measure_errors("ehs", run), measure_errors("servo", run)
    assert servo["xj"] < position * bare["xj"] and servo["p12"] < pressure * bare["p12"]


@real
def test_no_signal_is_predicted_from_itself() -> None:
    """P12 does not use the measured pressures; XJ from the motor's speed alone is worse."""
    driven, alone, bare = (measure_errors(model, "2_2", is_driven) for model, is_driven in (
        ("servo", True), ("servo", False), ("ehs", False)))
    assert driven["p12"] == alone["p12"] and 1.1 * driven["xj"] < alone["xj"] < 0.8 * bare["xj"]


@real
def test_compare_finds_the_shipped_model_by_its_name() -> None:
    """Its error does not depend on the steps of a cycle; that from the command alone falls as well."""
    found = rig("compare", DATA / "exp_data_1_1.csv.gz", "--model", "servo", "--json").json["signals"]
    assert found["xj"]["error"] == pytest.approx(measure_errors("servo", "1_1")["xj"], rel=0.03)
    bare = replay_command(read_run("1_1"), load_model("ehs"), STEPS)
    assert found["xj"]["closed_loop_error"] < 0.8 * rms(bare["xj"])

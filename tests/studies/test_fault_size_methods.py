"""Other methods for the fault sizes: the optimisers improve on the grid, the learners know units they never saw."""

import pytest
from noisy_traces import SHORT, record_plant

from fdi.diagnosis.diagnosis import Diagnosis, diagnose
from fdi.diagnosis.faults import FRICTION, Level
from studies import fault_size_methods as methods


@pytest.fixture(scope="module")
def other_command() -> Diagnosis:
    return diagnose(record_plant({"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0}, SHORT))


def test_global_optimisers_leave_less_than_the_grid(other_command: Diagnosis) -> None:
    d, grid = other_command, (0.1, 38.0)
    at_grid = methods.Objective(methods.make_problem(d.model, d.trace, d.floor), d.model, grid)
    left = at_grid.report("grid", at_grid.start).left
    for name in ("differential evolution", "simulated annealing", "genetic"):
        if name != "genetic" or methods.is_installed("pygad"):
            found = methods.METHODS[name](d.model, d.trace, grid, d.floor, 0)
            assert found.left < 0.9 * left and 200 < found.simulations < 500
            assert 19.0 <= found.fss <= 76.0 and 0.0 <= found.kintas <= 0.3


def test_learners_know_units_that_they_never_saw(other_command: Diagnosis) -> None:
    if not methods.is_installed("sklearn"):
        pytest.skip("needs scikit-learn")
    data = methods.simulate_lesson(other_command.trace, other_command.model, cloggings=(0.0, 0.3),
                                       frictions=(5.0, 45.0, 90.0), held_out=4)
    assert data.unseen.sum() == 2 * 3 * 4
    for learner in methods.LEARNERS.values():
        found = learner(data)
        assert found.right[FRICTION.name] > 0.9 and found.levels[FRICTION.name] == Level.MAINTENANCE.word

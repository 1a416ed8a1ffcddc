"""The plant of a run with its faults and its load, as the emulator and the rig's own cycle move it."""

from plant import Model
from rig.nodes.faulty_plant import FaultyPlant
from rig.nodes.scenario import Scenario
from rig.sequences.faults import Noise, Plan, Stuck


def test_the_transducers_say_the_same_when_they_are_asked_again() -> None:
    """While the controller is being enabled the cycle does not go on: no noise is drawn for it twice."""
    faults = (Noise(signal="p12", start=0.003, value=1e5), Stuck(signal="xj", start=0.005))
    scenario = Scenario(Model(), Plan(faults=faults, stop=20), seed=3)
    once, often = FaultyPlant(scenario), FaultyPlant(scenario)
    for k in range(20):
        said = once.read(k)
        assert [often.read(k) for _ in range(1 + k % 3)] == [said] * (1 + k % 3)
        for each in (once, often):
            each.current = 1e-3
            each.move(k)
    assert once.actuator.state == often.actuator.state

"""Which cycle loop plays a run: the bus, the pace and the nodes decide."""

from rig.benches.bench import Bench
from rig.network.bus import LinkWire, can_open
from rig.network.master import Master
from rig.nodes.scenario import Scenario
from rig.run.embedded_loop import EmbeddedLoop, Limits, can_play_many, is_compiled, load_code
from rig.run.job import Job
from rig.run.loop import CycleLoop, CycleObserver, Loop
from rig.sequences.faults import Schedule


def compile_loop(job: Job) -> None:
    """Compile the cycle of a job, before any node is started: some seconds on a new machine."""
    if job.realtime and can_open(job.bus):
        from rig.run.hard_loop import compile_cycle  # here: in lockstep a run needs none of it

        compile_cycle()
    elif job.controller == "builtin" and not job.realtime and is_compiled():
        load_code()


def open_loop(master: Master, bench: Bench, scenario: Scenario, faults: Schedule, log: CycleObserver, bus: str,
              realtime: bool, guards: Limits | None = None) -> Loop:
    """The cycle loop for a bus: in real time the hard one where compiled code can use the bus, else one in Python.

    With `guards`, limits of signals, cycles of a run may be played together.

    Raises:
        RigError: the bus cannot be opened.
    """
    is_compiled = bench.has_plant_node or scenario.model.kind.foreign is None  # or Python moves the plant
    if realtime and can_open(bus) and isinstance(master.wire, LinkWire) and is_compiled:
        from rig.network.raw_bus import RawBus  # here: in lockstep a run needs none of it
        from rig.run.hard_loop import HardLoop

        return HardLoop(master, bench, scenario, faults, log, RawBus(bus, bench.frames.identifiers))
    if guards is not None and not realtime and can_play_many(master, bench):
        return EmbeddedLoop(master, bench, scenario, faults, log, guards)
    return CycleLoop(master, bench, scenario, faults, log, realtime)

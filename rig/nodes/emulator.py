"""The plant emulator: the actuator behind a CANopen interface.

At each SYNC it reads its transducers and sends them, then moves the plant one cycle with the current that was latched:
the answer to cycle k acts from cycle k+1. All faults are loaded before the start (object 0x2210), so a fault takes no
bus time and begins exactly in the cycle that the sequence gives.
"""

from abc import ABC, abstractmethod
from functools import partial
from typing import cast

from plant import load_model
from plant.errors import InputError, require
from rig.benches.bench import Bench, CanopenNode, Flags
from rig.benches.bench_file import load_bench
from rig.device import Abort, Device, EmcyCode, ErrorRegister, NmtState, SdoAbort
from rig.network import heartbeat
from rig.network.frame import Frame, Send
from rig.network.node_objects import COUNTERS, PLANT, SCENARIO
from rig.nodes.scenario import FaultyPlant, Scenario
from rig.sequences.faults import DOUBLE, LateFrames, Plan, Schedule

_NO_FLAGS = Flags(0)  # made once: an operation on an IntFlag takes a microsecond


def find_plant_node(bench: Bench) -> CanopenNode:
    """The plant node of a bench.

    Raises:
        InputError: the bench has none, or one that lacks a signal or frame of our emulator.
    """
    require(PLANT in bench.nodes, bench.name, "plant_node",
            "a table with the plant as a node; the rig itself moves the plant of this bench")
    node, roles = bench.nodes[PLANT], [role for each in bench.frames.frames for role in each.roles]
    needed = ((("feedback", "valve_state", "drive"), roles),
              ((*(s.word for s in bench.signals.outputs), "flags", "cycle"), node.outputs),
              ((bench.signals.drive.word, "cycle"), node.inputs))
    lacking = [word for words, known in needed for word in words if word not in known]
    require(not lacking, bench.name, "plant_node", "frames of feedback and valve state, which carry all outputs of the "
                                                   f"plant, flags and cycle, not one without {', '.join(lacking)}")
    return node


class PlantNode(ABC):
    """The plant as a CANopen node, whatever runs its cycle. Its interface is `receive` and `tick`."""

    _scenario: Scenario | None = None

    def __init__(self, send: Send, bench: Bench | None) -> None:
        """`bench`: whose plant it is; default: the shipped one."""
        self._send, self._bench = send, bench or load_bench()
        self._node = node = find_plant_node(self._bench)
        self._heartbeat = node.find_cob_id(heartbeat.COB_ID)
        self.device = Device(node.node, node.eds, self._transmit)
        self.device.on_write, self.device.on_nmt = self._on_write, self._on_nmt
        self._od = self.device.od.values
        drive = self._bench.frames.drive.identifier
        self._drive = next(pdo for pdo in self.device.pdo.rpdos.values() if pdo.cob_id == drive)

    def load_scenario(self, scenario: Scenario | None) -> None:
        """Load a plant with its faults and loads; it is compiled now, not in the first cycle. None: that of the bench.

        Raises:
            InputError: a scenario that cannot be run, or of a plant with other signals than those of the bench; the
                previous one stays.
        """
        scenario = scenario or Scenario(load_model(self._bench.plant), Plan(stop=0))
        own, named = ([(s.word, s.unit) for s in (*signals.outputs, signals.drive)]
                      for signals in (scenario.model.kind.signals, self._bench.signals))
        require(own == named, "--model", scenario.model.name, "a plant with the signals of the bench: "
                f"{', '.join(f'{word} ({unit})' for word, unit in named)}")
        self._begin(scenario)

    def _on_write(self, index: int, sub: int, data: bytes) -> None:
        """Load what was downloaded, if it was object 0x2210, the scenario.

        Raises:
            SdoAbort: the node is OPERATIONAL, or the bytes are no scenario that can be run.
        """
        if index != SCENARIO:
            return
        if self.device.state is NmtState.OPERATIONAL:
            raise SdoAbort(Abort.STATE)
        try:
            self.load_scenario(Scenario.from_bytes(data))
        except InputError as error:
            raise SdoAbort(Abort.VALUE) from error

    def _pass_on(self, cob_id: int, data: bytes, faults: Schedule, k: int, is_running: bool) -> None:
        """Send a frame of the services unless a fault keeps it back. `k` is the cycle of the SYNC to come.

        `is_running`: there was a SYNC. Before it there is no cycle, and bring-up needs the heartbeat.
        """
        is_silent = cob_id == self._heartbeat and is_running and not faults.is_heartbeat_alive("plant", k)
        if not is_silent and not faults.is_bus_off("plant", k - 1):
            self._send(cob_id, data)

    @abstractmethod
    def _begin(self, scenario: Scenario) -> None:
        """Begin anew with this scenario; the SYNC to come is that of cycle 0."""

    @abstractmethod
    def _transmit(self, cob_id: int, data: bytes) -> None:
        """A frame of the device."""

    @abstractmethod
    def _on_nmt(self, old: NmtState, new: NmtState) -> None:
        """The state has changed."""


class Emulator(PlantNode):
    """The plant node in Python; `scenario` is used until the rig loads another."""

    def __init__(self, send: Send, scenario: Scenario | None = None, bench: Bench | None = None) -> None:
        super().__init__(send, bench)
        node, frames, signals = self._node, self._bench.frames, self._bench.signals
        self._names = {frames.find_role(name).identifier: name for name in ("feedback", "valve_state")}
        self._written = [node.outputs[s.word] for s in signals.outputs]
        self._flags, self._number = (node.outputs[signal] for signal in ("flags", "cycle"))
        self._driving, self._answered = (node.inputs[word] for word in (signals.drive.word, "cycle"))
        self._drive_id, self._sync_id = frames.drive.identifier, frames.sync
        self._most_missed = self._bench.most_missed
        self.device.on_sync = self._on_sync
        self.load_scenario(scenario)

    def _begin(self, scenario: Scenario) -> None:
        self.plant = FaultyPlant(scenario)
        self._scenario, self._faults = scenario, self.plant.faults
        self._cycle = 0  # of the SYNC to come
        self._begun = False  # SYNCs are counted from the first start
        self._first = True  # of the cycles after a start: no drive can have answered yet
        self._moved = True
        self._missed = 0  # drive frames missing in a row
        self._synced = -1  # the cycle of the last SYNC
        self._received, self._sent = LateFrames(), LateFrames()
        for sub in (1, 2):
            self._od[COUNTERS, sub] = 0

    def receive(self, frame: Frame) -> None:
        """A frame of another node arrived: a fault may delay or drop it."""
        if frame.cob_id == self._drive_id:
            action = self._faults.find_action("drive", self._cycle - 1)
            self._received.pass_on(action, frame.data, frame.t_ns,
                                   lambda data: self.device.receive(frame._replace(data=data)))
            return
        is_sync = frame.cob_id == self._sync_id
        is_cycle = is_sync and self._begun
        if self._faults.is_bus_off("plant", self._cycle if is_sync else self._cycle - 1):
            if is_cycle:  # it receives nothing, but its plant goes on
                self._pass_cycle()
            return
        if is_cycle:
            for _ in range(self._faults.count_lost_syncs(self._cycle)):  # time went on for the plant
                self._pass_cycle()
            is_second = (self._synced == self._cycle - 1
                         and self._faults.find_action("sync", self._synced).code == DOUBLE)
            self._synced = -1 if is_second else self._cycle
            if is_second:
                self._answer_again()
                return
            if self.device.state is not NmtState.OPERATIONAL:
                self._cycle += 1  # time goes on while the plant pauses
        self.device.receive(frame)
        if not self._moved:  # after the answer to a SYNC has gone out
            self._move()

    def _pass_cycle(self) -> None:
        """A cycle of which the node heard no SYNC: the current stays, and is zeroed after three."""
        if self.device.state is NmtState.OPERATIONAL:
            self._miss(1)
            self.plant.pass_unread(self._cycle)
        self._cycle += 1

    def _answer_again(self) -> None:
        """Send the PDOs of this SYNC once more; the plant does not move twice."""
        if self.device.state is NmtState.OPERATIONAL:
            for tpdo in self.device.pdo.cyclic:
                tpdo.send()

    def is_quiet(self, k: int) -> bool:
        """Whether the SYNC to come is that of cycle k, and nothing else is under way: no frame is late or missing."""
        is_steady = self._moved and not self._first and not self._missed and self._synced == self._cycle - 1
        return (is_steady and self._cycle == k and self.device.state is NmtState.OPERATIONAL
                and not self._received and not self._sent and self._drive.is_waiting)

    def pass_quiet(self, cycles: int, drive: bytes) -> None:
        """So many cycles were simulated elsewhere, on the state of `plant`; the last was answered by `drive`."""
        self._cycle += cycles
        self._synced = self._cycle - 1
        self.plant.pass_quiet(cycles)
        self._drive.put(drive)

    def tick(self, t_ns: int) -> None:
        """Deliver the delayed frames that are due at `t_ns`."""
        self._received.release(t_ns + 1)
        self._sent.release(t_ns + 1)
        self.device.tick(t_ns)

    def _transmit(self, cob_id: int, data: bytes) -> None:
        """Send a frame unless a fault drops or delays it."""
        if (name := self._names.get(cob_id)) is not None:
            self._sent.pass_on(self._faults.find_action(name, self._cycle), data, self.device.t_ns,
                               partial(self._send, cob_id))
            return
        self._pass_on(cob_id, data, self._faults, self._cycle, not self._first)

    def _on_nmt(self, old: NmtState, new: NmtState) -> None:
        """The first start begins a run; after a pause the plant continues from its last state."""
        if new is NmtState.OPERATIONAL:
            self._begun = self._first = True
        elif new is NmtState.INITIALISING:
            assert self._scenario is not None
            self._begin(self._scenario)

    def _on_sync(self) -> None:
        """The drive that came last is latched: judge it, read the transducers, leave the rest until they are sent."""
        k, od = self._cycle, self._od
        flags = _NO_FLAGS if self._first else self._judge(k)
        self._first = False
        readings = self.plant.read(k)
        if readings is None:
            # The simulation diverged (an extreme parameter, a division by zero): stop, send no invented value. Whatever
            # 0x1029 says, the node becomes PRE-OPERATIONAL: no feedback any more.
            self.device.emcy.raise_error(EmcyCode.SOFTWARE, ErrorRegister.GENERIC, b"\x03")
            self.device.nmt.communication_error(0)
            return
        for place, reading in zip(self._written, readings, strict=True):
            od[place.key] = place.field.compute_counts(reading)
        od[self._flags.key], od[self._number.key] = int(flags), self._number.field.wrap_number(k)
        self._moved = False

    def _judge(self, k: int) -> Flags:
        """Whether the latched drive answers the cycle before this one; the current to use until the next SYNC.

        A missing or late answer leaves the current as it was; after three in a row there is none (EMCY 0x8250) until
        answers come again.
        """
        fresh = self._drive.fresh
        if fresh and self._od[self._answered.key] == self._answered.field.wrap_number(k - 1):
            self.plant.drive = self._driving.field.compute_value(cast(float, self._od[self._driving.key]))
            if self._missed >= self._most_missed:
                self.device.emcy.clear(EmcyCode.RPDO_TIMEOUT)
            self._missed = 0
            return _NO_FLAGS
        return Flags.DRIVE_LATE | self._miss(2) if fresh else Flags.DRIVE_MISSING | self._miss(1)

    def _miss(self, counter: int) -> Flags:
        """No answer to the last cycle; the flag if it was one too many: then there is no current."""
        self._missed += 1
        self._od[COUNTERS, counter] = cast(int, self._od[COUNTERS, counter]) + 1
        if self._missed < self._most_missed:
            return _NO_FLAGS
        self.plant.drive = 0.0
        self.device.emcy.raise_error(EmcyCode.RPDO_TIMEOUT, ErrorRegister.COMMUNICATION, bytes((self._drive.n,)))
        return Flags.CURRENT_ZEROED

    def _move(self) -> None:
        """Advance the plant by one cycle."""
        self.plant.move(self._cycle)
        self._moved = True
        self._cycle += 1

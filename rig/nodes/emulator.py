"""The plant emulator: the actuator behind a CANopen interface.

At each SYNC it reads its transducers and sends them, then moves the plant one cycle with the current that was latched:
the answer to cycle k acts from cycle k+1. All faults are loaded before the start (object 0x2210), so a fault takes no
bus time and begins exactly in the cycle that the sequence gives.

The cycle is compiled (emulator_cycle.py). Here are the CANopen services, which share its memory, and the node whose
frames Python brings; one that has a bus of its own is in emulator_service.py.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from plant import InputError, Model, load_model, require
from rig.benches import RPDO, TPDO, VALUES_AT, Bench, CanopenNode, load_bench
from rig.device import Abort, Device, EmcyCode, ErrorRegister, NmtState, SdoAbort
from rig.network import COUNTERS, PLANT, SCENARIO, Frame, Port, Send, heartbeat
from rig.nodes import emulator_cycle as ec
from rig.nodes.called_loop import call_loop, load_loop, make_port
from rig.nodes.plant_code import CompiledPlant, load_plant
from rig.nodes.scenario import Scenario
from rig.sequences import DROP, Plan

_RAISED = {  # events of the cycle: the errors that they raise
    ec.TIMEOUT_RAISED: (EmcyCode.RPDO_TIMEOUT, ErrorRegister.COMMUNICATION),
    ec.DRIVE_SHORT: (EmcyCode.PDO_TOO_SHORT, ErrorRegister.COMMUNICATION),
    ec.DIVERGED: (EmcyCode.SOFTWARE, ErrorRegister.GENERIC)}
_CLEARED = {ec.TIMEOUT_CLEARED: EmcyCode.RPDO_TIMEOUT, ec.DRIVE_WHOLE: EmcyCode.PDO_TOO_SHORT}


def find_plant_node(bench: Bench) -> CanopenNode:
    """The plant node of a bench.

    Raises:
        InputError: the bench has none, or one that lacks a signal or frame of our emulator.
    """
    require(PLANT in bench.nodes, bench.name, "plant_node",
            "a table with the plant as a node; the rig itself moves the plant of this bench")
    node, roles = bench.nodes[PLANT], [role for each in bench.frames.frames for role in each.roles]
    requirements = ((("feedback", "valve_state", "drive"), roles),
                    ((*(s.word for s in bench.signals.outputs), "flags", "cycle"), node.outputs),
                    ((bench.signals.drive.word, "cycle"), node.inputs))
    missing = [word for words, names in requirements for word in words if word not in names]
    require(not missing, bench.name, "plant_node", "frames of feedback and valve state, which carry all outputs of the "
                                                   f"plant, flags and cycle, not one without {', '.join(missing)}")
    return node


class PlantNode:
    """The plant as a CANopen node: the services, whatever runs its cycle. Its interface is `receive` and `tick`."""

    _scenario: Scenario | None = None
    _memory: ec.Memory  # what the cycle works on

    def __init__(self, send: Send, bench: Bench | None) -> None:
        """`bench`: whose plant it is; default: the shipped one."""
        self._send, self._bench = send, bench or load_bench()
        self._node = node = find_plant_node(self._bench)
        # COB-IDs of the predefined connection set (CiA 301, 7.3.3)
        self._heartbeat, self._sdo = heartbeat.COB_ID + node.node, 0x600 + node.node
        self._unheard = list_unheard(self._bench)
        self.device = Device(node.node, node.eds, self._transmit)
        self.device.on_write, self.device.on_nmt = self._on_write, self._on_nmt
        self._od = self.device.od.values
        self._frames = [self._bench.frames.find_role(role) for role in ("drive", "feedback", "valve_state")]
        rpdos, tpdos = self.device.pdo.rpdos.values(), self.device.pdo.tpdos.values()
        self._drive = next(pdo for pdo in rpdos if pdo.cob_id == self._frames[0].identifier)
        self._tpdos = [next(pdo for pdo in tpdos if pdo.cob_id == spec.identifier) for spec in self._frames[1:]]
        self._obeying = False  # an NMT command, which the cycle obeys by itself
        self._booking = False  # an error whose EMCY the cycle has sent
        self._diverged = ""

    @property
    def problem(self) -> str:
        """Why the plant can go on no more; empty if it can."""
        return self._plant.problem or self._diverged

    def load_scenario(self, scenario: Scenario | None) -> None:
        """Load a plant with its faults and loads; it is compiled now, not in the first cycle. None: that of the bench.

        Raises:
            InputError: a scenario that cannot be run, or of a plant with other signals than those of the bench; the
                previous one stays.
        """
        scenario = scenario or Scenario(load_model(self._bench.plant), Plan(stop=0))
        plant_signals, bench_signals = ([(s.word, s.unit) for s in (*signals.outputs, signals.drive)]
                                        for signals in (scenario.model.kind.signals, self._bench.signals))
        require(plant_signals == bench_signals, "--model", scenario.model.name,
                "a plant with the signals of the bench: "
                f"{', '.join(f'{word} ({unit})' for word, unit in bench_signals)}")
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

    def _begin(self, scenario: Scenario) -> None:
        """Make new memory for the cycle; the SYNC to come is that of cycle 0. The node stays in its NMT state."""
        plant = load_plant(scenario)
        memory = ec.make_memory(scenario, *plant.code, self._frames)
        words, cycle_field = memory.words, self._node.inputs["cycle"].field
        words[ec.NODE: ec.MISSED_LIMIT + 1] = (self._node.node, self._drive.n, cycle_field.wrap_number(-1),
                                               self._bench.most_missed)
        with self._pause():
            if self._scenario:
                words[ec.STATE] = self._memory.words[ec.DEMOTED] or self._memory.words[ec.STATE]
            words[ec.BEGUN] = words[ec.FIRST] = words[ec.STATE] == ec.OPERATIONAL
            self._scenario, self._memory, self._schedule = scenario, memory, scenario.make_schedule()
            self._plant, self._diverged = plant, ""
            self._noise = np.random.default_rng(scenario.seed)
            self._seen = self._noticed = 0
            ec.fill_noise(self._memory, self._noise)
            self._share_settings()

    @contextmanager
    def _pause(self) -> Iterator[None]:
        """Let the cycle rest, and go on with what has been set meanwhile."""
        yield

    def receive(self, frame: Frame) -> None:
        """A frame for the services arrived."""
        is_bus_off = self._schedule.is_bus_off("plant", int(self._memory.words[ec.CYCLE]) - 1)
        if frame.cob_id in self._unheard or is_bus_off:
            return
        self._book_events()
        if frame.cob_id == self._sdo:
            self._show_values(frame.data)
        self.device.receive(frame)

    def _obey(self, command: int) -> None:
        """Do what the cycle has done at an NMT command, or left to the services."""
        self._obeying = True
        try:
            self.device.receive(Frame(self.device.t_ns, 0, bytes((command, self.device.node_id))))
        finally:
            self._obeying = False

    def _transmit(self, cob_id: int, data: bytes) -> None:
        """Send a frame of the services unless a fault or the cycle has dealt with it."""
        if self._booking and cob_id == self._memory.words[ec.EMCY_ID]:
            return
        words, faults, is_beat = self._memory.words, self._schedule, cob_id == self._heartbeat
        if not is_beat or data == bytes(1):
            self._share_settings()  # what SDO has written is in force when it is confirmed
        if is_beat and data == bytes(1) and not words[ec.STATE]:  # the first boot-up
            words[ec.STATE] = ec.PRE_OPERATIONAL
        k = int(words[ec.CYCLE])
        # before the first SYNC there is no cycle, and bring-up needs the heartbeat
        is_silent = is_beat and words[ec.BEGUN] and not words[ec.FIRST] and not faults.is_heartbeat_alive("plant", k)
        if not is_silent and not faults.is_bus_off("plant", k - 1):
            self._send(cob_id, data)

    def _on_nmt(self, old: NmtState, new: NmtState) -> None:
        if new is NmtState.INITIALISING:
            assert self._scenario is not None
            self._memory.words[ec.DEMOTED] = ec.PRE_OPERATIONAL
            self._begin(self._scenario)
        elif not self._obeying and old is NmtState.OPERATIONAL:  # an error of the services: 0x1029
            self._memory.words[ec.DEMOTED] = new

    def _share_settings(self) -> None:
        """What SDO may change, and the error register without the cycle's own error."""
        words, od = self._memory.words, self.device.od
        words[ec.PERIOD] = od.read_number(0x1006, 0)
        emcy = od.read_number(0x1014, 0, 1 << 31)
        words[ec.EMCY_ID] = -1 if emcy >> 31 else emcy & 0x7FF
        errors = [code for code in self.device.emcy.active if code != EmcyCode.RPDO_TIMEOUT]
        communication = any(code != EmcyCode.SOFTWARE for code in errors)
        words[ec.OTHER_REGISTER] = ErrorRegister.GENERIC * bool(errors) | ErrorRegister.COMMUNICATION * communication
        for row, tpdo in enumerate(self._tpdos):
            at, kind = ec.TPDOS_AT + 4 * row, od.read_number(TPDO + tpdo.n - 1, 2)
            words[at + ec.ID] = -1 if tpdo.cob_id is None else tpdo.cob_id
            if words[at + ec.TYPE] != kind:
                words[at + ec.TYPE] = words[at + ec.COUNT] = kind
        words[ec.DRIVE_TYPE] = od.read_number(RPDO + self._drive.n - 1, 2)
        words[ec.SYNC_ID] = od.read_number(0x1005, 0, 0x80) & 0x7FF
        words[ec.DRIVE_ID] = -1 if self._drive.cob_id is None else self._drive.cob_id

    def _book_events(self) -> None:
        """Take over what the cycle noticed or did: errors, whose EMCY it sends itself or leaves to the services."""
        emcy, t_ns, number = self.device.emcy, self.device.t_ns, bytes((self._drive.n,))
        while self._seen < self._memory.words[ec.EVENTS]:
            event = self._memory.words[ec.EVENTS_AT + self._seen % ec.EVENT_RING]
            self._seen += 1
            self._booking = event in (ec.TIMEOUT_RAISED, ec.TIMEOUT_CLEARED)
            if event >= ec.COMMANDED:
                self._obey(int(event) - ec.COMMANDED)
            elif event == ec.SYNC_MALFORMED:
                self.device.sync.receive(Frame(t_ns, self._bench.frames.sync or 0, b"\0"))
            elif event in _RAISED:
                emcy.raise_error(*_RAISED[event], b"\x03" if event == ec.DIVERGED else number)
            else:
                emcy.clear(_CLEARED[event], number if event == ec.DRIVE_WHOLE else b"")
            if event == ec.DIVERGED:
                self._diverged = ec.explain_divergence(self._memory, self._bench.signals)
                self._obeying = True  # the cycle has left OPERATIONAL
                self.device.nmt.communication_error(0)
                self._obeying = False
            self._booking = False

    def _show_values(self, request: bytes) -> None:
        """Put the values of the cycle into the dictionary, which an SDO request is about to read."""
        words, frames, signals = self._memory.words, self._memory.frames, ec.list_channels(self._bench.signals)
        values = dict(zip(signals, frames.doubles[frames.words[VALUES_AT]:], strict=False))
        for places, cycle in ((self._node.outputs, ec.FRAME_CYCLE), (self._node.inputs, ec.ANSWERED)):
            for signal, (key, field) in places.items():
                self._od[key] = (field.wrap_number(int(words[cycle])) if signal == "cycle" else
                                 field.compute_counts(values.get(signal, 0.0)))
        self._od[COUNTERS, 1], self._od[COUNTERS, 2] = int(words[ec.MISSING]), int(words[ec.LATE])


class Emulator(PlantNode):
    """The plant node whose frames Python brings; `scenario` is used until the rig loads another."""

    def __init__(self, send: Send, scenario: Scenario | None = None, bench: Bench | None = None) -> None:
        super().__init__(send, bench)
        self._port = make_port()
        self.load_scenario(scenario)

    def _begin(self, scenario: Scenario) -> None:
        super()._begin(scenario)
        self._run = load_service().bind((self._port, self._memory))

    def _share_settings(self) -> None:
        super()._share_settings()
        self._memory.words[ec.PERIOD] = 1  # a frame is late by the clock, also in lockstep

    def receive(self, frame: Frame) -> None:
        """A frame of another node arrived."""
        words, device, is_sync = self._memory.words, self.device, frame.cob_id == self._memory.words[ec.SYNC_ID]
        if not is_sync and frame.cob_id not in (0, words[ec.DRIVE_ID]):
            super().receive(frame)
            return
        device.t_ns = frame.t_ns
        is_heard = device.state is NmtState.OPERATIONAL and not self._schedule.is_bus_off("plant", int(words[ec.CYCLE]))
        if is_sync and is_heard:
            self._notice_sync(frame)
        words[ec.PUSHED], words[ec.PUSHED_TIME], words[ec.PUSHED_ID] = 1, frame.t_ns, frame.cob_id
        words[ec.PUSHED_LENGTH] = len(frame.data)
        words[ec.PUSHED_DATA] = int.from_bytes(frame.data[:8].ljust(8, b"\0"), "little", signed=True)
        self._play(frame.t_ns)

    def _notice_sync(self, frame: Frame) -> None:
        """What was missed before this SYNC is reported before what ends with it."""
        if self._schedule.find_action("sync", int(self._memory.words[ec.CYCLE])).code == DROP:
            self._memory.words[ec.PUSHED] = ec.LOST_SYNCS
            self._play(frame.t_ns)
        if not frame.data:
            self.device.sync.notice(frame.t_ns)

    def tick(self, t_ns: int) -> None:
        """Deliver the delayed frames that are due at `t_ns`, and run the timers."""
        if self._memory.words[ec.HELD]:
            self.device.t_ns = t_ns
            self._play(t_ns)
        ec.fill_noise(self._memory, self._noise)
        self.device.tick(t_ns)

    def _play(self, t_ns: int) -> None:
        for cob_id, data in call_loop(self._port, self._run, t_ns):
            self._send(cob_id, data)
        self._book_events()
        if command := int(self._memory.words[ec.RESET_COMMAND]):
            self._obey(command)

    def share_memory(self, k: int) -> ec.Memory | None:
        """The plant, for compiled code that moves it from cycle k on.

        None unless that is the next one and nothing else is under way: no frame is late or missing.
        """
        words = self._memory.words
        is_steady = words[ec.WAITING] and not (words[ec.FIRST] or words[ec.MISSED] or words[ec.HELD])
        is_next = words[ec.CYCLE] == k and words[ec.SYNCED] == k - 1
        return self._memory if is_next and is_steady and self.device.state is NmtState.OPERATIONAL else None

    def pass_quiet(self, cycles: int, drive: int) -> None:
        """So many cycles were simulated elsewhere, on the memory of this node; the last was answered by `drive`."""
        words = self._memory.words
        words[ec.CYCLE] += cycles
        words[ec.SYNCED], words[ec.WAITING_DATA] = words[ec.CYCLE] - 1, drive


def make_trial() -> tuple[Port, ec.Memory]:
    """Arguments for one SYNC of the shipped bench."""
    bench = load_bench()
    memory = ec.make_memory(Scenario(Model(), Plan(stop=0)), *CompiledPlant(Model()).code,
                            [bench.frames.find_role(role) for role in ("drive", "feedback", "valve_state")])
    memory.words[ec.STATE], memory.words[ec.SYNC_ID], memory.words[ec.PUSHED_ID] = ec.OPERATIONAL, 0x080, 0x080
    memory.words[ec.PUSHED] = memory.words[ec.PERIOD] = 1
    ec.fill_noise(memory, np.random.default_rng(0))
    return make_port(), memory


load_service = partial(load_loop, ec.serve_frame, make_trial)  # the cycle of the node, for any plant


def list_unheard(bench: Bench) -> tuple[int, ...]:
    """What the services need not hear: the frames of the bench, and what the cycle hears."""
    return 0x000, *bench.frames.identifiers

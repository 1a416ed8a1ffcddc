"""The nodes on the bus of a run: in this process, in processes of our own, or external ones."""
from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

from plant import InputError, Model, require
from rig.benches import Role, is_plant_bench
from rig.interrupts import end_with
from rig.network import (
    CONTROLLER,
    NAMES,
    PLANT,
    RIG,
    BusError,
    EmbeddedWire,
    Link,
    LinkWire,
    Master,
    Node,
    Send,
    VirtualClock,
    WallClock,
    Wire,
    open_can,
)
from rig.nodes import Emulator, Firmware, StandIn
from rig.run.job import Job
from rig.sequences import is_noticed_by_time

EMBEDDED_NAMES = ("embedded", "virtual")
FRAME_TIMEOUT = 2.0  # s: in lockstep a frame may be this late, for the machine may be busy
LOST_FRAME_TIMEOUT = 0.2  # s: the same where frames are to be lost, so that the run comes to an end


@contextlib.contextmanager
def open_participants(job: Job) -> Iterator[tuple[Wire, NodeProcesses]]:
    """Open the bus and start the nodes of this job on it: inside this process, or as processes of their own.

    Yields the rig's end of the bus, and the processes.

    Raises:
        InputError: an external node on a bus that no other program can reach, or an external firmware together with
            an effect in the firmware.
        BusError: an external node does not answer.
    """
    in_firmware = find_firmware_parameters(job.model)
    require(job.controller == "builtin" or not in_firmware, "--controller", job.controller,
            f"a model without effects in the firmware, which only the builtin one has: not {', '.join(in_firmware)}")
    if job.bus.partition(":")[0] in EMBEDDED_NAMES:
        external = " and ".join(name for name in ("controller", "plant") if getattr(job, name) == "external")
        require(job.controller == "builtin" and not external, "--bus", job.bus,
                "a bus between programs, such as udp_multicast:239.74.163.5 or socketcan:can0" + (
                    f", on which you start the {external} of {job.bench.name!r} first" if external else ""))
        makers: list[Callable[[Send], Node]] = (
            [Emulator, partial(Firmware, model=job.model)] if job.bench.has_plant_node else
            [partial(StandIn, bench=job.bench, model=job.model)])
        wire = EmbeddedWire(WallClock() if job.realtime else VirtualClock(), makers, job.period_ns)
        yield wire, NodeProcesses()
        return
    _require_time(job)
    require(not (job.controller == "builtin" and is_plant_bench(job.bench)), "--bus", job.bus,
            "embedded: the controller that the plant declares runs inside the rig")
    if job.controller == "c":
        require_firmware_bus(job.bus)
        from rig.firmware.build import build_controller  # here and below: other runs need no compiler

        build_controller()  # now, where an error is still reported before anything is on the bus
    clock = WallClock()
    timeout = LOST_FRAME_TIMEOUT if job.sequence.loses_frames else FRAME_TIMEOUT
    link_wire = LinkWire(Link(open_can(job.bus, job.bench.bitrate, job.bench.frames.is_fd), clock.now), clock, timeout)
    if job.bench.nodes:  # until bring-up is over: boot-ups must not be lost among the frames of others
        link_wire.link.select_frames([*job.bench.frames.by_identifier, *dict(job.bench.list_services())])
    processes = NodeProcesses()
    try:
        _start_missing_nodes(job, Master(link_wire, clock.now, False, job.bench), processes)
        yield link_wire, processes
    finally:
        processes.stop()
        link_wire.close()


def _require_time(job: Job) -> None:
    """Refuse faults that nodes notice by the time, where there is none: in lockstep between processes."""
    labels = [fault.label for fault in job.sequence.faults if is_noticed_by_time(fault)]
    if labels and not job.realtime:
        raise InputError("--pace", "lockstep", f"realtime, or the embedded bus, for the fault {labels[0]!r}: in "
                                               "lockstep between processes nodes watch neither SYNC nor heartbeats")


def _start_missing_nodes(job: Job, master: Master, processes: NodeProcesses, rival_time: float = 0.25,
                         boot_time: float = 0.7, external_boot_time: float = 2.0) -> None:
    """Start the nodes of this job that do not answer on the bus.

    Args:
        job, master, processes: what is to be there, how to ask for it, and where to start it.
        rival_time: s; another rig at work is heard within this.
        boot_time: s; a node that is there boots within this.
        external_boot_time: s; a node that must be there, perhaps on a busy machine, boots within this.

    Raises:
        BusError: another rig, or a node that does not answer.
    """
    bench = job.bench
    if master.hears_rival(rival_time):  # before sending anything: a reset would end the other rig's test
        raise BusError(f"another rig is active on {job.bus}: received a frame of {bench.describe_node(RIG)}")
    for node, choice in ((PLANT, job.plant), (CONTROLLER, job.controller)):
        if node not in bench.nodes:
            continue
        name, number = bench.describe_node(node), bench.find_number(node)
        limit = external_boot_time if choice == "external" else boot_time
        is_present = (choice != "builtin" or node == CONTROLLER) and master.is_present(node, limit)
        if choice == "external" and not is_present:
            raise BusError(f"{name} does not answer on {job.bus}")
        if node == CONTROLLER and choice != "external" and is_present:
            raise BusError(f"a node {number} is on {job.bus} already: say --controller external, or stop it")
        if not is_present:
            processes.start(node, _make_command(job, node))
            if is_replaced(master, node, processes) and choice != "auto":
                raise BusError(f"a {name} is on {job.bus} already: stop it, or say "
                               f"--{NAMES[node]} external")


def require_firmware_bus(bus: str) -> None:
    """Refuse a bus for which the C firmware has no port. Raises InputError."""
    require(bus.partition(":")[0] in ("socketcan", "udp_multicast"), "--bus", bus,
            "socketcan:INTERFACE or udp_multicast[:GROUP] for --controller c")


def find_firmware_parameters(model: Model) -> dict[str, float]:
    """The parameters of the effects at work in a model's firmware."""
    return {name: model[name] for effect in map(model.find_effect, model.effects)
            if effect.firmware and effect.is_active(model.values) for name in effect.parameters}


def make_node_command(node: Role, bus: str, *words: str, is_in_c: bool = False) -> list[str]:
    """The command that runs a node of ours as a process of its own."""
    if is_in_c:
        from rig.firmware.build import build_controller

        return [str(build_controller()), bus]
    return [sys.executable, "-m", "rig.cli.main", "node", NAMES[node], "--bus", bus, "--quiet", "--announce", *words]


def _make_command(job: Job, node: Role) -> list[str]:
    """The command that runs a node of this job."""
    # all else about the model comes by SDO
    parameters = find_firmware_parameters(job.model) if node == CONTROLLER else {}
    words = [*(word for path in job.effects for word in ("--effects", str(path))),
             *(["--model", job.model.plant] if node == PLANT and job.model.kind.foreign is not None else []),
             *(word for parameter, value in parameters.items() for word in ("--set", f"{parameter}={value!r}"))]
    return make_node_command(node, job.bus, *words, is_in_c=node == CONTROLLER and job.controller == "c")


def is_replaced(master: Master, node: Role, processes: NodeProcesses, seconds: int = 180) -> bool:
    """Wait until a node of our own answers, which may have to compile its loop and the plant; False.

    True if somebody else's node came first. Ours has then found it on the bus and ended, see `rig node`. That is why
    an answer alone is not enough: it may be the answer of the other one.

    Raises:
        BusError: no node answers.
    """
    for _ in range(seconds):
        is_present = master.is_present(node, 1.0)
        if node in processes.find_ended():
            if not is_present:
                raise BusError(f"our own {NAMES[node]} did not start")
            processes.forget(node)
            return True
        if is_present and processes.is_ready(node):
            return False
        if is_present:  # another one; ours is about to notice
            processes.wait([node])
    raise BusError(f"our own {NAMES[node]} did not answer within {seconds} s")


class NodeProcesses:
    """Processes of this run, by role; they end with it, also when it is killed. Each has its own session, so that
    Ctrl-C reaches the rig alone: clean-up needs its plant.
    """

    def __init__(self) -> None:
        self._children: dict[Role, subprocess.Popen[bytes]] = {}

    def start(self, node: Role, command: Sequence[str]) -> None:
        """Start a node as a new process, which writes a line as soon as it is on the bus."""
        self._children[node] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                                start_new_session=True, preexec_fn=partial(end_with, os.getpid()))

    def is_ready(self, node: Role) -> bool:
        """Whether the node has said that it is on the bus."""
        output = self._children[node].stdout
        assert output is not None
        return bool(select.select([output], [], [], 0)[0] and output.readline())  # nothing: it has ended

    def forget(self, node: Role) -> None:
        """Leave out a node whose process has ended: another one has taken its place on the bus."""
        self._children.pop(node).communicate()

    def find_ended(self) -> dict[Role, int]:
        """Nodes whose process has ended, with its exit status; negative: the signal that ended it."""
        return {node: status for node, child in self._children.items() if (status := child.poll()) is not None}

    def wait(self, nodes: Iterable[Role], seconds: float = 1.0) -> None:
        """Wait until the processes of these nodes end, for so long each; other nodes are left out.

        On a busy machine a process takes some time from the signal that kills it to its end.
        """
        for child in (self._children[node] for node in nodes if node in self._children):
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(seconds)

    def stop(self) -> None:
        """Terminate all processes; kill those that do not end within 5 s."""
        for child in self._children.values():
            child.terminate()
        for child in self._children.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(5)
            child.kill()
            child.communicate()

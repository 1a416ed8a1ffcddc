"""How much of the bus the frames of a bench take, each at its longest; as a report for terminal, page and JSON."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from fdi.report import Cell, Column, Report, Section, Table, tabulate
from rig.benches.bench import EXTENDED, FD, SWITCHED, Bench, FrameSpec, Protection, Role, describe_identifier

HEARTBEAT = 0.1  # s, of each node of the rig


class FrameLoad(NamedTuple):
    """A frame of a bench, and its share of the bus."""

    name: str
    identifier: int  # with EXTENDED, FD and SWITCHED
    direction: str  # "rig > controller"
    length: int  # bytes
    content: tuple[str, ...]  # signals, and what protects them
    period: float  # s
    share: float  # of the time


def count_bits(identifier: int, length: int) -> int:
    """The bit times that a frame of `length` bytes takes at most, with all stuff bits and the space behind it.

    Of classical frames as in Davis, Burns, Bril, Lukkien, Controller Area Network (CAN) schedulability analysis, 2007;
    of CAN FD frames by the fields of ISO 11898-1, all at the nominal bit rate.

    >>> count_bits(0x182, 8), count_bits(0x80, 0)
    (135, 55)
    """
    stuffed_bits = 54 if identifier & EXTENDED else 34  # of a classical frame beside the data that stuffing may extend
    if not identifier & FD:
        return stuffed_bits + 8 * length + 13 + (stuffed_bits + 8 * length - 1) // 4
    head = (41 if identifier & EXTENDED else 22) + 8 * length
    checksum = 4 + (17 if length <= 16 else 21)  # stuff count and CRC, with a stuff bit before each four bits
    return head + (head - 1) // 4 + checksum + -(-checksum // 4) + 13


def compute_time(identifier: int, length: int, bitrate: float, data_bitrate: float | None = None) -> float:
    """The time that a frame takes on the bus at most, s; of CAN FD with BRS all from ESI to the CRC at `data_bitrate`.

    >>> compute_time(0x123 | FD | SWITCHED, 64, 1e6), compute_time(0x123 | FD | SWITCHED, 64, 1e6, 5e6)
    (0.000712, 0.0001696)
    """
    bits = count_bits(identifier, length)
    if not identifier & SWITCHED or data_bitrate is None:
        return bits / bitrate
    head = 36 if identifier & EXTENDED else 17  # up to BRS
    slow = head + (head - 1) // 4 + 13
    return slow / bitrate + (bits - slow) / data_bitrate


def list_loads(bench: Bench) -> list[FrameLoad]:
    """The cyclic frames of a bench, then SYNC and the heartbeats.

    The rig sends each page of a multiplexed message in each period, a controller one page after the other.
    """
    cycle = bench.cycle_ns / 1e9
    pages = Counter(spec.sent_as for spec in bench.frames.frames if spec.sender is not Role.RIG)
    sync = [] if bench.frames.sync is None else [("SYNC", bench.frames.sync, "rig > all", 0, (), cycle)]
    nodes = {Role.RIG: bench.rig_node, **{role: each.node for role, each in bench.nodes.items()}} if bench.nodes else {}
    rows = [*((spec.name, spec.sent_as, _describe_direction(bench, spec), spec.length, list_content(spec),
               cycle * spec.every) for spec in bench.frames.frames), *sync,
            *((f"heartbeat {node}", 0x700 + node, f"{role.name.lower()} > all", 1, (), HEARTBEAT)
              for role, node in sorted(nodes.items()))]
    return [FrameLoad(*each, share=compute_time(each[1], each[3], bench.bitrate, bench.data_bitrate) / each[5]
                      / max(pages[each[1]], 1))
            for each in rows]


def _describe_direction(bench: Bench, spec: FrameSpec) -> str:
    if spec.sender is Role.RIG:
        return "rig > controller"
    if spec.sender is Role.CONTROLLER:
        return "controller > rig, plant" if bench.has_plant_node else "controller > rig"
    return "plant > rig" if spec.roles == ("valve_state",) else "plant > rig, controller"


def list_content(spec: FrameSpec) -> tuple[str, ...]:
    """The named fields of a frame in words.

    A selector has its value, a protected field what it is.
    """
    words = {Protection.NONE: "", Protection.COUNTER: " (counter)"}
    return tuple(f"{each.name} = {each.fixed}" if each.fixed is not None else
                 each.name + words.get(each.protection, f" ({each.checksum.partition('#')[0]})")
                 for each in spec.fields if each.name)


_IDENTIFIER = 0x1FFF_FFFF


def build_bench_report(bench: Bench, files: Sequence[tuple[str, str]] = ()) -> Report:
    """Report on the frames of a bench; `files` are (label, path) of the files written."""
    loads = list_loads(bench)
    load, rate = sum(each.share for each in loads), f"{bench.bitrate / 1000:g} kbit/s"
    is_possible = load <= 1
    sentence = (f"The frames take at most {100 * load:.0f} % of the bus at {rate}." if is_possible else
                f"The frames need {100 * load:.0f} % of the bus at {rate}; a longer cycle or a higher bit rate.")
    nodes = [bench.describe_node(role) for role in (Role.CONTROLLER, Role.PLANT) if role in bench.nodes]
    facts = [("protocol", "CANopen" if bench.nodes else "CAN"), *([("nodes", ", ".join(nodes))] if nodes else []),
             ("profile", bench.profile), ("plant", bench.plant), ("cycle", f"{bench.cycle_ns / 1e6:g} ms")]
    notes = []
    if any(each.identifier & SWITCHED for each in loads):
        data_rate = "that of 'bitrate': give 'data_bitrate'" if bench.data_bitrate is None else (
            f"{bench.data_bitrate / 1e6:g} Mbit/s")
        notes.append(f"BRS: the data of these frames are counted at {data_rate}")
    verdict = "WITHIN_LIMITS" if is_possible else "BEYOND_LIMITS"
    return Report(command="check", title=f"Bench: {bench.name}", verdict=verdict, mood="good" if is_possible else "bad",
                  sentence=sentence, facts=facts, notes=notes, sections=[Section("Frames", [tabulate_frames(loads)])],
                  files=files, data={"verdict": verdict, "bench": collect_bench_data(bench, loads)})


def tabulate_frames(loads: Sequence[FrameLoad]) -> Table:
    """The frames of a bench, each with its share of the bus, and the sum."""
    total = FrameLoad("sum", 0, "", 0, (), 0.0, sum(each.share for each in loads))
    return tabulate(
        [*loads, total],
        (Column("frame"), lambda each: Cell(each.name, is_strong=each is not total)),
        (Column("identifier"), lambda each: "" if each is total else (
            describe_identifier(each.identifier) + " FD" * bool(each.identifier & FD)
            + ", BRS" * bool(each.identifier & SWITCHED))),
        (Column("from > to"), lambda each: each.direction),
        (Column("bytes", align="right"), lambda each: "" if each is total else str(each.length)),
        (Column("signals"), lambda each: ", ".join(each.content)),
        (Column("period", "ms", align="right"), lambda each: "" if each is total else f"{1000 * each.period:g}"),
        (Column("bus", "%", align="right"), lambda each: f"{100 * each.share:.1f}"),
        caption="Share of the time, each frame at its longest (all stuff bits).")


def collect_bench_data(bench: Bench, loads: Sequence[FrameLoad]) -> dict[str, Any]:
    """The bench as the JSON answer has it."""
    frames = [{"name": each.name, "identifier": each.identifier & _IDENTIFIER,
               "extended": bool(each.identifier & EXTENDED), "fd": bool(each.identifier & FD),
               "brs": bool(each.identifier & SWITCHED),
               "direction": each.direction, "bytes": each.length, "signals": list(each.content),
               "period": each.period, "share": each.share} for each in loads]
    return {"name": bench.name, "plant": bench.plant, "protocol": "canopen" if bench.nodes else "can",
            "profile": bench.profile, "cycle": bench.cycle_ns / 1e9, "bitrate": bench.bitrate,
            "nodes": {role.name.lower(): node.node for role, node in bench.nodes.items()},
            "load": sum(each.share for each in loads), "frames": frames, "files": list(bench.files)}

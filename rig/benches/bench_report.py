"""The frames of a bench as a report for terminal, page and JSON."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fdi.report.report import Cell, Column, Report, Section, Table, tabulate
from rig.benches.bench import Bench
from rig.benches.bus_load import FrameLoad, list_loads
from rig.benches.frame_map import EXTENDED, FD, SWITCHED, Role, describe_identifier

_IDENTIFIER = 0x1FFF_FFFF


def build_bench_report(bench: Bench, files: Sequence[tuple[str, str]] = ()) -> Report:
    """Report on the frames of a bench; `files` are (label, path) of the files written."""
    loads = list_loads(bench)
    load, rate = sum(each.share for each in loads), f"{bench.bitrate / 1000:g} kbit/s"
    is_possible = load <= 1
    sentence = f"The frames take at most {100 * load:.0f} % of the bus at {rate}."
    if not is_possible:
        sentence = f"The frames need {100 * load:.0f} % of the bus at {rate}; a longer cycle or a higher bit rate."
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
                  files=files, data={"verdict": verdict, "bench": collect_data(bench, loads)})


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


def collect_data(bench: Bench, loads: Sequence[FrameLoad]) -> dict[str, Any]:
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

"""Each defect of a device is found by the cases that are there for it, and by no others."""

from typing import Any

import pytest
from broken_devices import (
    Break,
    change_entries,
    examine,
    hear_instead,
    keep_values_over_reset,
    list_cases,
    send_instead,
    skip_checks,
    wrap,
    wrap_all,
)

from rig.device import Abort, NmtState, SdoAbort
from rig.device.dictionary import INVALID

PDOS = (0x1400, 0x1800, 0x1801)
SDO, ANSWER, EMCY, HEARTBEAT = 0x603, 0x583, 0x083, 0x703  # COB-IDs of node 3


def accept_restricted(device: Any, old: Any, index: int, sub: int, value: int) -> None:
    """Only a restricted identifier is let through; that of a valid PDO is still fixed."""
    if not (index in PDOS and sub == 1 and device.od.read_number(index, 1) & INVALID):
        old(index, sub, value)


def change_while_valid(device: Any, old: Any, index: int, sub: int, value: int) -> None:
    """Any permitted identifier is accepted at any time."""
    word = device.od.read_number(index, sub)
    if index in PDOS and sub == 1:
        device.od.values[index, sub] = word | INVALID
    try:
        old(index, sub, value)
    finally:
        device.od.values[index, sub] = word


def ignore_length(device: Any, old: Any, index: int, sub: int, data: bytes) -> Any:
    size = device.od.find_size(index, sub)
    return old(index, sub, data[:size].ljust(size, b"\0") if size else data)


def serve_stopped(device: Any, old: Any) -> None:
    old()
    if device.state is NmtState.STOPPED:
        device._handlers[SDO] = device.sdo.receive


def send_before_start(device: Any, old: Any) -> None:
    old()
    if device.state is NmtState.PRE_OPERATIONAL:
        device._handlers[0x080] = lambda frame: [tpdo.send() for tpdo in device.pdo.cyclic]


def repeat_emcy(device: Any, old: Any, code: int, register: int = 1, info: bytes = b"") -> None:
    device.emcy._active.pop((code, info[:1]), None)
    old(code, register, info)


def watch_at_once(device: Any, old: Any, entries: list[int]) -> None:
    """Supervision begins with the entry, not with the first heartbeat."""
    old(entries)
    for node, limit in device.consumer._limits.items():
        device.consumer._deadlines.setdefault(node, device.t_ns + limit)


def watch_slackly(device: Any, old: Any, entries: list[int]) -> None:
    old(entries)
    device.consumer._limits = {node: 2 * limit for node, limit in device.consumer._limits.items()}


def latch_at_once(device: Any, rpdo: Any, old: Any, frame: Any) -> None:
    old(frame)
    rpdo.latch()


def lose_disable(device: Any, pdo: Any, old: Any) -> None:
    """Bit 31 of the COB-ID is stored and has no effect."""
    old()
    base = 0x1800 if pdo in device.pdo.tpdos.values() else 0x1400
    pdo.cob_id = device.od.read_number(base + pdo.n - 1, 1) & 0x7FF


def start_by_itself(device: Any, old: Any) -> None:
    old()
    device._enter(NmtState.OPERATIONAL)


def refuse_version(device: Any, old: Any, index: int, sub: int) -> Any:
    if index == 0x1009:
        raise SdoAbort(Abort.NO_OBJECT)
    return old(index, sub)


def hang_after_timeout(device: Any, old: Any, t_ns: int) -> None:
    """After a transfer that was not finished the server is dead until a reset."""
    was_open = device.sdo._open
    old(t_ns)
    if was_open is not None and device.sdo._open is None:
        device._handlers.pop(SDO, None)


def all_of(*patches: Break) -> Break:
    def patch(device: Any) -> None:
        for each in patches:
            each(device)
    return patch


def change_abort(old_code: int, new_code: int) -> Break:
    return wrap("sdo._abort", lambda device, old, code: old(new_code if code == old_code else code))


def fill_up(first: int, last: int) -> Break:
    """Frames with these COB-IDs are heard with 8 bytes."""
    return hear_instead(lambda frame: frame._replace(data=frame.data.ljust(8, b"\0"))
                        if first <= frame.cob_id <= last and frame.data else frame)


DEFECTS: list[tuple[str, Break, str]] = [
    ("COB-ID of a valid PDO may be changed", wrap("_check", change_while_valid), "4.7"),
    ("restricted COB-IDs accepted", wrap("_check", accept_restricted), "4.8"),
    ("consumer entries are not checked", skip_checks(0x1016), "5.13"),
    ("toggle bit ignored", wrap("sdo._segment", lambda device, old, command, data:
                                old(command & ~0x10 | device.sdo._toggle, data)), "3.6 3.7"),
    ("block transfer unanswered", wrap("sdo._answer", lambda device, old, data:
                                       b"" if data[0] >> 5 in (5, 6) else old(data)), "3.10"),
    ("block transfer refused with another code", change_abort(Abort.COMMAND, 0x08000000), "3.8 3.9 3.10 3.11"),
    ("unknown object: another code", change_abort(Abort.NO_OBJECT, Abort.NO_SUBINDEX), "2.7"),
    ("unknown sub-index: another code", change_abort(Abort.NO_SUBINDEX, Abort.NO_OBJECT), "2.8"),
    ("write-only: another code", change_abort(Abort.WRITE_ONLY, 0x06010000), "2.10"),
    ("read-only objects written", change_entries(writable=True), "2.9"),
    ("any length accepted", all_of(wrap("od.decode", ignore_length),
                                   wrap("sdo._size", lambda device, old, index, sub: old(index, sub) * 0)),
     "2.12 3.13"),
    ("limits ignored", change_entries(low=None, high=None), "2.13"),
    ("constant differs from the EDS", wrap("sdo._upload", lambda device, old, index, sub: old(index, sub)
                                           if (index, sub) != (0x1018, 2) else bytes(4)), "2.3"),
    ("object of the EDS cannot be read", wrap("od.find", refuse_version), "2.1 2.3 2.8 2.14"),
    ("value too wide", wrap("sdo._upload", lambda device, old, index, sub:
                            old(index, sub).ljust(4, b"\0") if index == 0x1017 else old(index, sub)),
     "2.2 2.4 2.11 2.12 3.2 3.3 3.5 6.11 6.12"),
    ("value of 0 bytes", wrap("sdo._upload", lambda device, old, index, sub:
                              b"" if index == 0x1017 else old(index, sub)),
     "2.2 2.4 2.8 2.12 3.2 3.3 3.5 3.7 3.13 3.14 6.11 6.12"),
    ("a write without effect", wrap("sdo._download", lambda device, old, index, sub, data:
                                    None if index == 0x1017 else old(index, sub, data)),
     "2.12 3.2 3.3 5.7 5.8 6.11 6.12 7.3"),
    ("client abort ignored", hear_instead(lambda frame: None if frame.cob_id == SDO and frame.data[:1] == b"\x80" else
                                          frame), "3.11"),
    ("announced length wrong", send_instead(ANSWER, lambda data: data[:4] + bytes((data[4] + 1,)) + data[5:]
                                            if data[0] == 0x41 else data),
     "2.1 2.3 2.9 2.14 3.4 3.6 3.11 3.12 3.15"),
    ("short requests answered", fill_up(SDO, SDO), "3.16"),
    ("requests to other nodes answered", hear_instead(lambda frame: frame._replace(cob_id=SDO)
                                                      if 0x600 < frame.cob_id < 0x680 else frame), "3.17"),
    ("server hangs after a timeout", wrap("sdo.tick", hang_after_timeout), "3.15"),
    ("every SYNC answered", wrap_all("pdo.tpdos", "on_sync", lambda device, tpdo, old: tpdo.send()), "4.3"),
    ("synchronous RPDO acts at once", wrap_all("pdo.rpdos", "receive", latch_at_once), "4.15"),
    ("short PDOs used", fill_up(0x181, 0x57F), "4.12 4.14 5.4 5.5 6.9"),
    ("bit 31 of the COB-ID without effect", all_of(wrap_all("pdo.rpdos", "configure", lose_disable),
                                                   wrap_all("pdo.tpdos", "configure", lose_disable)), "4.10 4.14"),
    ("mapped objects swapped", send_instead(0x283, lambda data: data[:4] + data[6:8] + data[4:6]), "4.16"),
    ("no EMCY", send_instead(EMCY, lambda data: None), "4.12 4.14 5.3 5.4 5.5 5.6 5.10 5.17 6.9"),
    ("EMCY repeated", wrap("emcy.raise_error", repeat_emcy), "5.4"),
    ("EMCY 0x0000 missing", send_instead(EMCY, lambda data: data if data[:2] != b"\0\0" else None), "5.5"),
    ("error register without bit 0", send_instead(EMCY, lambda data: data[:2] + bytes((data[2] & ~1,)) + data[3:]),
     "5.3"),
    ("history not erased", wrap("emcy.erase_history", lambda device, old: None), "5.6"),
    ("SYNC with data: another error", send_instead(EMCY, lambda data: b"\x00\x50" + data[2:]
                                                   if data[:2] == b"\x40\x82" else data), "5.16"),
    ("EMCY in STOPPED", wrap("emcy._permitted", lambda device, old: True), "6.10"),
    ("heartbeat too slow", wrap("heartbeat.configure", lambda device, old, period, t_ns: old(period * 12 // 10, t_ns)),
     "5.7"),
    ("heartbeat with toggle bit", send_instead(HEARTBEAT, lambda data: bytes((data[0] | 0x80,)) if data[0] else data),
     "5.9"),
    ("heartbeat never lost", wrap("consumer.tick", lambda device, old, t_ns: None), "5.3 5.6 5.10 5.12 5.17"),
    ("heartbeat lost too late", wrap("consumer.configure", watch_slackly), "5.10"),
    ("heartbeat missed before it came", wrap("consumer.configure", watch_at_once), "4.10 4.14 5.11 6.4 7.4"),
    ("no boot-up", wrap("heartbeat.send_boot_up", lambda device, old: None),
     "5.12 5.17 6.1 6.2 6.3 6.5 6.11 6.12 6.13 7.2"),
    ("starts by itself", wrap("_boot", start_by_itself), "6.3 6.13"),
    ("stays STOPPED", wrap("nmt.receive", lambda device, old, frame: None if device.state is NmtState.STOPPED
                           and frame.data[:1] <= b"\x80" else old(frame)), "6.4 6.5 6.8"),
    ("obeys commands for others", hear_instead(lambda frame: frame._replace(data=frame.data[:1] + b"\3")
                                               if frame.cob_id == 0 and len(frame.data) == 2 and frame.data[1] else
                                               frame), "6.6"),
    ("ignores commands for all", hear_instead(lambda frame: None if frame.cob_id == 0 and frame.data[1:] == b"\0" else
                                              frame), "6.5"),
    ("obeys short commands", hear_instead(lambda frame: frame._replace(data=frame.data + b"\0")
                                          if frame.cob_id == 0 and len(frame.data) == 1 else frame), "6.7"),
    ("SDO in STOPPED", wrap("_gate", serve_stopped), "6.8"),
    ("PDO in PRE-OPERATIONAL", wrap("_gate", send_before_start), "6.9"),
    ("reset restores nothing", keep_values_over_reset, "5.6 5.17 6.11 6.12"),
    ("SDO slow", send_instead(ANSWER, lambda data: data, lambda data: 90), "7.1"),
    ("PDO slow", send_instead(0x283, lambda data: data, lambda data: 45), "7.4"),
    ("boot-up slow", send_instead(HEARTBEAT, lambda data: data, lambda data: 0 if data[0] else 2500), "7.2"),
]


@pytest.mark.parametrize(("patch", "found_by"), [each[1:] for each in DEFECTS], ids=[each[0] for each in DEFECTS])
def test_defect_is_found(patch: Break, found_by: str) -> None:
    assert list_cases(examine(patch)) == found_by.split()


def test_reset_node_that_restores_no_application_object_is_found() -> None:
    """The plant has no such object that can be written, the controller has."""
    patch = wrap("od.restore", lambda device, old, first, last: old(first, min(last, 0x1FFF)))
    assert list_cases(examine(patch, 2)) == ["6.12"]

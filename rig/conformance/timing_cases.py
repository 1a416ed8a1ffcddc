"""Chapter 7: how long the node takes. CiA 301 sets few limits; those used here are named in each case."""
from __future__ import annotations

from collections.abc import Sequence

from rig.conformance.conformance_case import Case, require, require_applicable
from rig.conformance.error_cases import measure_periods
from rig.conformance.pdo_cases import identify, list_sent, operational, set_type
from rig.conformance.sdo_cases import READ_TYPE
from rig.conformance.target import COMMANDS, OPERATIONAL, Target
from rig.network.node_objects import NmtCommand


def check_sdo_response(t: Target) -> str:
    """CiA 301 gives no limit: 50 ms are a tenth of the time after which clients commonly give up."""
    times = []
    for _ in range(100):
        start = t.now()
        t.demand(READ_TYPE)
        times.append((t.frames[-1].t_ns - start) * 1e-6)
    return require_times(t, times, 0.99, 50.0)


def check_boot_time(t: Target) -> str:
    """CiA 301 gives no limit."""
    times = []
    for _ in range(3):
        start = t.now()
        times.append((t.reset(NmtCommand.RESET_NODE).t_ns - start) * 1e-6)
    return require_times(t, times, 1.0, 2000.0)


def check_first_request(t: Target) -> str:
    """A node that announced itself is ready."""
    boot = t.reset(NmtCommand.RESET_NODE)
    t.demand(READ_TYPE)
    return f"{(t.frames[-1].t_ns - boot.t_ns) * 1e-6:.1f} ms after the boot-up"


def check_heartbeat_jitter(t: Target) -> str:
    """Thirty periods. CiA 301 gives no limit; consumers allow half a period at least."""
    errors = [abs(period - 50.0) for period in measure_periods(t, 50, 30)]
    return f"off by {require_times(t, errors, 1.0, 10.0)}"


def check_sync_response(t: Target) -> str:
    """A hundred SYNCs, 20 ms apart; none may be left out."""
    ids = {identify(t, pdo): pdo.name for pdo in list_sent(t) if set_type(t, pdo, 1)}
    require_applicable(ids, "no TPDO is synchronous")
    window = t.read(0x1007) * 1e-3 if t.sheet.find(0x1007) else 0.0  # ms
    times: list[float] = []
    with operational(t):
        for _ in range(100):
            start, mark = t.now(), len(t.frames)
            t.sync()
            t.wait(t.options.timeout, lambda: {frame.cob_id for frame in t.heard(mark)} >= set(ids))  # noqa: B023
            arrived = {frame.cob_id: (frame.t_ns - start) * 1e-6 for frame in t.heard(mark, *ids)}
            missing = [name for cob_id, name in ids.items() if cob_id not in arrived]
            require(not missing, f"no {', '.join(missing)} after a SYNC")
            times += arrived.values()
            t.wait(max(0.0, 0.02 - (t.now() - start) * 1e-9))
    return f"{', '.join(ids.values())}: {require_times(t, times, 0.99, window or 10.0)}"


def check_start_time(t: Target) -> str:
    """Seen in the heartbeat, which comes every 5 ms, or as often as the node can."""
    t.beat(5)
    start = t.now()
    t.command(COMMANDS[OPERATIONAL])
    frames = t.wait_for(t.heartbeat_id, 1.0 + t.options.tolerance, lambda frame: frame.data == bytes((OPERATIONAL,)))
    require(frames, "not OPERATIONAL within 1 s")
    return f"{(frames[0].t_ns - start) * 1e-6:.0f} ms"


def require_times(t: Target, times: Sequence[float], share: float, limit: float) -> str:
    """Median, 99th percentile and maximum of times in ms; of a few, all.

    Raises Problem unless this share of them keeps to the limit and the tolerance.
    """
    def find(part: float) -> float:
        return sorted(times)[round(part * (len(times) - 1))]

    limit += 1e3 * t.options.tolerance
    text = f"p50 {find(0.5):.2f}, p99 {find(0.99):.2f}, max {max(times):.2f} ms"
    if len(times) < 10:
        text = f"{', '.join(f'{each:.1f}' for each in times)} ms"
    require(find(share) <= limit, f"{text}, limit {limit:.1f} ms")
    return text


CASES = (
    Case("7.1", "SDO response time", "7.2.4.3", "99 of 100 uploads of 0x1000 are answered within 50 ms",
         check_sdo_response, is_timed=True),
    Case("7.2", "boot time", "7.3.2.2.1", "boot-up within 2 s of a reset node", check_boot_time, is_timed=True),
    Case("7.3", "SDO after boot-up", "7.3.2.2.2", "the first request after the boot-up is answered",
         check_first_request, is_timed=True),
    Case("7.4", "heartbeat jitter", "7.2.8.3.2.2", "no period of 50 ms is off by more than 10 ms and the tolerance",
         check_heartbeat_jitter, is_timed=True),
    Case("7.5", "SYNC to PDO", "7.2.2.2, 7.5.2.7",
         "each synchronous TPDO comes within the window 0x1007, or else within the tolerance and 10 ms",
         check_sync_response, is_timed=True),
    Case("7.6", "start", "7.2.8.2.1.2", "OPERATIONAL within 1 s of the command", check_start_time, is_timed=True),
)

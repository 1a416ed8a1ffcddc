"""Chapter 7: how long the node takes. CiA 301 sets few limits; those used here are named in each case."""
from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

from rig.conformance.conformance_case import CaseFailed, case, require, require_applicable
from rig.conformance.pdo_cases import INVALID, have_all_come, operational
from rig.conformance.target import HEAD, OPERATIONAL, RESET_NODE, START, Target


@case("7.1", "SDO response time", "7.2.4.3", "99 of 100 uploads of 0x1000 are answered within 50 ms", is_timed=True)
def check_sdo_response(t: Target) -> str:
    """CiA 301 gives no limit: 50 ms are a tenth of the time after which clients commonly give up."""
    times = []
    for _ in range(100):
        start = t.now()
        t.demand(HEAD.pack(0x40, 0x1000, 0) + bytes(4))
        times.append((t.frames[-1].t_ns - start) * 1e-6)
    require(_share(times, 0.99) <= 50.0 + 1e3 * t.options.tolerance, _format(times))
    return _format(times)


@case("7.2", "boot time", "7.3.2.2.1", "boot-up within 2 s of a reset node", is_timed=True)
def check_boot_time(t: Target) -> str:
    """CiA 301 gives no limit."""
    times = []
    for _ in range(3):
        start = t.now()
        times.append((t.reset(RESET_NODE).t_ns - start) * 1e-6)
    require(max(times) <= 2000.0 + 1e3 * t.options.tolerance, _format(times))
    return _format(times)


@case("7.3", "SDO after boot-up", "7.3.2.2.2", "the first request after the boot-up is answered", is_timed=True)
def check_first_request(t: Target) -> str:
    """A node that announced itself is ready."""
    boot = t.reset(RESET_NODE)
    answer = t.ask(HEAD.pack(0x40, 0x1000, 0) + bytes(4))
    if answer is None:
        raise CaseFailed(f"no answer within {t.options.timeout:g} s")
    return f"{(t.frames[-1].t_ns - boot.t_ns) * 1e-6:.1f} ms after the boot-up"


@case("7.4", "heartbeat jitter", "7.2.8.3.2.2", "no period of 50 ms is off by more than 10 ms and the tolerance",
      is_timed=True)
def check_heartbeat_jitter(t: Target) -> str:
    """Thirty periods. CiA 301 gives no limit; consumers allow half a period at least."""
    t.require_writable(0x1017)
    t.beat(50)
    t.wait_for(t.heartbeat_id, 1.0)
    mark = len(t.frames)
    t.wait_for(t.heartbeat_id, 4.0, count=31)
    times = [frame.t_ns for frame in t.frames[mark:] if frame.cob_id == t.heartbeat_id]
    require(len(times) >= 31, f"{len(times)} heartbeats in 4 s")
    errors = [abs((late - early) * 1e-6 - 50.0) for early, late in pairwise(times)]
    require(max(errors) <= 10.0 + 1e3 * t.options.tolerance, f"off by {_format(errors)}")
    return f"off by {_format(errors)}"


@case("7.5", "SYNC to PDO", "7.2.2.2, 7.5.2.7",
      "each synchronous TPDO comes within the window 0x1007, or else within the tolerance and 10 ms", is_timed=True)
def check_sync_response(t: Target) -> str:
    """A hundred SYNCs, 20 ms apart; none may be left out."""
    chosen = [pdo for pdo in t.sheet.pdos if pdo.is_sent and not t.read(pdo.parameter, 1) & INVALID
              and (t.read(pdo.parameter, 2) == 1 or (t.sheet.is_writable(pdo.parameter, 2)
                                                     and not t.try_download(pdo.parameter, 2, b"\1")))]
    require_applicable(chosen, "no TPDO is synchronous")
    window = t.read(0x1007) * 1e-3 if t.sheet.find(0x1007) else 0.0  # ms
    limit = (window or 10.0) + 1e3 * t.options.tolerance
    ids = {t.read(pdo.parameter, 1) & 0x7FF: pdo.name for pdo in chosen}
    times: list[float] = []
    with operational(t):
        for _ in range(100):
            start, mark = t.now(), len(t.frames)
            t.sync()
            t.wait(t.options.timeout, partial(have_all_come, t, mark, set(ids)))
            arrived = {frame.cob_id: (frame.t_ns - start) * 1e-6 for frame in t.frames[mark:] if frame.cob_id in ids}
            missing = [name for cob_id, name in ids.items() if cob_id not in arrived]
            require(not missing, f"no {', '.join(missing)} after a SYNC")
            times += arrived.values()
            t.wait(max(0.0, 0.02 - (t.now() - start) * 1e-9))
    require(_share(times, 0.99) <= limit, f"{_format(times)}, limit {limit:.1f} ms")
    return f"{', '.join(ids.values())}: {_format(times)}"


@case("7.6", "start", "7.2.8.2.1.2", "OPERATIONAL within 1 s of the command", is_timed=True)
def check_start_time(t: Target) -> str:
    """Seen in the heartbeat, which comes every 5 ms, or as often as the node can."""
    t.beat(5)
    start = t.now()
    t.command(START)
    frame = t.wait_for(t.heartbeat_id, 1.0 + t.options.tolerance, lambda frame: frame.data == bytes((OPERATIONAL,)))
    if frame is None:
        raise CaseFailed("not OPERATIONAL within 1 s")
    return f"{(frame.t_ns - start) * 1e-6:.0f} ms"


def _share(times: Sequence[float], share: float) -> float:
    """The value that this share of the times does not exceed."""
    return sorted(times)[min(len(times) - 1, round(share * (len(times) - 1)))]


def _format(times: Sequence[float]) -> str:
    """Median, 99th percentile and maximum of times in ms."""
    if len(times) < 10:
        return f"{', '.join(f'{each:.1f}' for each in times)} ms"
    return f"p50 {_share(times, 0.5):.2f}, p99 {_share(times, 0.99):.2f}, max {max(times):.2f} ms"

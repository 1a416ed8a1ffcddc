"""SYNC consumer (CiA 301, 7.2.5): what happens at a SYNC, and whether they still come (0x1006)."""

from collections.abc import Callable

from rig.device.emcy import Emcy, EmcyCode, ErrorRegister
from rig.network import Frame

# 0x1006 gives the period of SYNC but not when SYNC counts as lost. The bench measures the lateness of a single SYNC
# itself; a dozen missing in a row mean that the producer is gone. The rig writes 8 ms.


class SyncConsumer:
    """Runs `cycle` at each SYNC; raises EMCY 0x8100 when they stop and 0x8240 for one that carries data."""

    def __init__(self, emcy: Emcy, cycle: Callable[[], None], report_lost: Callable[[], None]) -> None:
        """`cycle()` at each SYNC; `report_lost()` when they stop, after the EMCY."""
        self._emcy, self._cycle, self._report_lost = emcy, cycle, report_lost
        self._limit_ns = 0
        self._deadline = 0  # 0: not waiting
        self._lost = self._malformed = False

    def configure(self, period_us: int, lost_after: int = 12) -> None:
        """A new communication cycle period (0x1006); 0: do not watch. Watching begins with the next SYNC.

        SYNC is lost after `lost_after` periods.
        """
        self._limit_ns = period_us * 1000 * lost_after
        self._deadline = 0

    def stop(self) -> None:
        """The device leaves OPERATIONAL: no SYNC is missed."""
        self._deadline = 0

    def receive(self, frame: Frame) -> None:
        if frame.data:  # a SYNC counter, which the device does not ask for (no 0x1019)
            self._malformed = True
            self._emcy.raise_error(EmcyCode.SYNC_LENGTH, ErrorRegister.COMMUNICATION)
            return
        self.notice(frame.t_ns)
        self._cycle()

    def notice(self, t_ns: int) -> None:
        """A SYNC came at `t_ns`: it is not lost. For a cycle that runs elsewhere, this is all there is to do."""
        if self._limit_ns:
            self._deadline = t_ns + self._limit_ns
        if self._lost or self._malformed:
            self._lost = self._malformed = False
            self._emcy.clear(EmcyCode.COMMUNICATION)
            self._emcy.clear(EmcyCode.SYNC_LENGTH)

    def tick(self, t_ns: int) -> None:
        if self._deadline and t_ns > self._deadline:
            self._deadline = 0
            self._lost = True
            self._emcy.raise_error(EmcyCode.COMMUNICATION, ErrorRegister.COMMUNICATION)
            self._report_lost()

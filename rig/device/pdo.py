"""PDOs (CiA 301, 7.2.2): communication and mapping read from the object dictionary, one precompiled struct each.

The mapping is fixed (1600.., 1A00.. are const); COB-ID and transmission type (1400.., 1800..) may be changed by SDO.
"""

import struct
from collections.abc import Callable

from plant import InputError, require
from rig.benches import EVENT_DRIVEN, INVALID, LAST_SYNCHRONOUS, MAPPING, RPDO, TPDO
from rig.device.dictionary import Dictionary, check_switchable, find_struct
from rig.device.emcy import Emcy, EmcyCode, ErrorRegister
from rig.device.sdo import Abort, abort_unless
from rig.network import Frame, Send


def read_mapping(od: Dictionary, index: int) -> tuple[list[tuple[int, int]], struct.Struct]:
    """What lies in a PDO, in order: the keys of the objects and the struct that packs them.

    Raises InputError if the dictionary maps what is not there, not mappable, of another length, or beyond 8 bytes, or
    lets a master change the mapping.
    """
    for sub in (0, *od.list_subs(index)):
        require((index, sub) not in od.entries or not od.entries[index, sub].writable, od.path,
                f"{index:04X}sub{sub:X}.AccessType", "const: the mapping cannot be changed")
    keys, codes = [], "<"
    for sub in range(1, od.read_number(index, 0) + 1):
        word = od.read_number(index, sub)
        key, bits = (word >> 16, word >> 8 & 0xFF), word & 0xFF
        entry = od.entries.get(key)
        number = None if entry is None or not entry.pdo_mappable else find_struct(entry)
        if number is None or 8 * number.size != bits:
            raise InputError(od.path, f"{index:04X}sub{sub:X}",
                             f"a mappable object and its length, not 0x{word:08X}")
        keys.append(key)
        codes += number.format.lstrip("<")
    packer = struct.Struct(codes)
    require(packer.size <= 8, od.path, f"{index:04X}", f"at most 8 bytes in a PDO, not {packer.size}")
    return keys, packer


class Pdo:
    """What both kinds of PDO have: communication parameters and mapping, as the dictionary at `base` has them."""

    def __init__(self, n: int, od: Dictionary, base: int) -> None:
        self.n, self._od, self._index = n, od, base + n - 1
        self._keys, self._struct = read_mapping(od, self._index + MAPPING)
        self.configure()

    def configure(self) -> None:
        """Read the communication parameters again. The COB-ID is None while the PDO is switched off (bit 31)."""
        word = self._od.read_number(self._index, 1)
        self.cob_id = None if word & INVALID else word & 0x7FF
        self._type = self._od.read_number(self._index, 2)
        self.synchronous = self._type <= LAST_SYNCHRONOUS


class Rpdo(Pdo):
    """A received PDO: put into the dictionary on arrival, or kept until the next SYNC if it is synchronous."""

    def __init__(self, n: int, od: Dictionary, emcy: Emcy, report_arrival: Callable[[int], None]) -> None:
        self.fresh = False  # synchronous: a new frame was latched at this SYNC
        self._emcy, self._report_arrival = emcy, report_arrival
        self._waiting: bytes | None = None
        self._faulty = False
        super().__init__(n, od, RPDO)
        self._size, self._unpack = self._struct.size, self._struct.unpack_from

    def configure(self) -> None:
        super().configure()
        if self.cob_id is None:
            self.forget()

    def forget(self) -> None:
        """Drop what waits for a SYNC: the device left OPERATIONAL, or the PDO was switched off."""
        self._waiting, self.fresh = None, False

    def receive(self, frame: Frame) -> None:
        data = frame.data
        if (len(data) != self._size or self._faulty) and not self._judge(len(data)):
            return
        if self.synchronous:
            self._waiting = data
        else:
            self._od.values.update(zip(self._keys, self._unpack(data), strict=True))
            self._report_arrival(self.n)

    def latch(self) -> None:
        """SYNC: what came last becomes valid."""
        data = self._waiting
        self.fresh = data is not None
        if data is not None:
            self._waiting = None
            self._od.values.update(zip(self._keys, self._unpack(data), strict=True))

    def _judge(self, length: int) -> bool:
        """Whether a frame of that length is used: too short no (EMCY 0x8210), too long its first bytes (0x8220)."""
        info = bytes((self.n,))
        for code, is_wrong in ((EmcyCode.PDO_TOO_SHORT, length < self._size),
                               (EmcyCode.PDO_TOO_LONG, length > self._size)):
            if is_wrong:
                self._emcy.raise_error(code, ErrorRegister.COMMUNICATION, info)
            else:
                self._emcy.clear(code, info)
        self._faulty = length != self._size
        return length >= self._size


class Tpdo(Pdo):
    """A transmitted PDO: every n-th SYNC (types 1..240), the first SYNC after `transmit` (0), or at once (254, 255)."""

    def __init__(self, n: int, od: Dictionary, send: Send) -> None:
        self._send = send
        super().__init__(n, od, TPDO)
        self._pack = self._struct.pack

    def configure(self) -> None:
        super().configure()
        self.forget()

    def forget(self) -> None:
        """Start counting SYNCs anew; nothing is due."""
        self._countdown = self._type
        self._requested = False

    def transmit(self) -> None:
        """The application asks for it. A cyclic synchronous PDO keeps to its SYNCs."""
        if self._type in EVENT_DRIVEN:
            self.send()
        else:
            self._requested = True

    def on_sync(self) -> None:
        if self._type == 0:
            due, self._requested = self._requested, False
        else:
            self._countdown -= 1
            due = self._countdown <= 0
        if due:
            self._countdown = self._type
            self.send()

    def send(self) -> None:
        if self.cob_id is not None:
            values = self._od.values
            self._send(self.cob_id, self._pack(*[values[key] for key in self._keys]))


class Pdos:
    """All PDOs of a device, by number from 1, and the ones a SYNC concerns."""

    def __init__(self, od: Dictionary, emcy: Emcy, send: Send, report_arrival: Callable[[int], None]) -> None:
        def numbers(base: int) -> list[int]:
            return [n for n in range(1, MAPPING + 1) if (base + n - 1, 1) in od.entries]

        self._od = od
        self.rpdos = {n: Rpdo(n, od, emcy, report_arrival) for n in numbers(RPDO)}
        self.tpdos = {n: Tpdo(n, od, send) for n in numbers(TPDO)}
        self._all: list[Rpdo | Tpdo] = [*self.rpdos.values(), *self.tpdos.values()]
        self.configure()

    def configure(self) -> None:
        """Read the communication parameters again."""
        for pdo in self._all:
            pdo.configure()
        self.latched = [pdo for pdo in self.rpdos.values() if pdo.synchronous]
        self.cyclic = [pdo for pdo in self.tpdos.values() if pdo.synchronous]

    def forget(self) -> None:
        """The device left OPERATIONAL."""
        for pdo in self._all:
            pdo.forget()

    def check(self, index: int, sub: int, value: int) -> None:
        """Refuse a communication parameter that CiA 301 forbids. Raises SdoAbort."""
        if sub == 1:
            check_switchable(self._od.read_number(index, 1), value)
            # else the device consumes SYNC under that identifier
            is_free = value & 0x7FF != self._od.read_number(0x1005, 0, 0x80) & 0x7FF
            abort_unless(value & INVALID or is_free, Abort.VALUE)
        elif sub == 2:  # those between are reserved, or by remote frame
            abort_unless(value <= LAST_SYNCHRONOUS or value >= EVENT_DRIVEN[0], Abort.VALUE)

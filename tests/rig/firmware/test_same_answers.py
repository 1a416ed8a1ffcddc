"""The C firmware, under the sanitizers for memory and undefined behaviour, sends what the Python one sends.

The script is random: sound traffic, requests with random bits, frames of wrong length, foreign frames, pauses, resets.
"""

import random
import struct
import subprocess
from collections.abc import Iterator

import pytest
from c_device import SANITIZERS, STRICT, SUPPORT, skip_without_compiler

from rig.firmware.build import FOLDER, build_program
from rig.network.frame import Frame
from rig.nodes.firmware import Firmware

RECORD = struct.Struct("<qHB8s")
TICK = 0xFFFF
MS = 1_000_000  # ns
NEEDS_A_BUS = ("main.c", "options.c", "serve.c", "port_socketcan.c", "port_udp.c", "turn.c", "wait.c", "datagram.c")


def make_script(seed: int, length: int) -> list[Frame]:
    """Frames and ticks (COB-ID `TICK`) in the order of time."""
    draw = random.Random(seed)
    firmware = Firmware(lambda cob_id, data: None)
    objects = list(firmware.device.od.entries)
    t_ns, script = 0, [Frame(0, TICK, b"")]
    while len(script) < length:
        t_ns += draw.choice((0, 20_000, 400_000, MS, 5 * MS, 300 * MS) if draw.random() < 0.02 else (20_000, 100_000))
        script += [Frame(t_ns, *step) for step in make_step(draw, objects)]
        if draw.random() < 0.2:
            script.append(Frame(t_ns, TICK, b""))
    return script


def make_step(draw: random.Random, objects: list[tuple[int, int]]) -> Iterator[tuple[int, bytes]]:
    """One cycle of sound traffic, or something else."""
    kind = draw.random()
    if kind < 0.02:
        yield 0x000, b"\x81\x02"  # an SDO request may have moved a PDO or set a gain that saturates
        yield 0x000, b"\x01\x02"
    elif kind < 0.45:
        control = draw.choice((7, 7, 7, 7, 15, 3, 1, 0, draw.randrange(1 << 16)))
        yield 0x202, struct.pack("<iHH", draw.randrange(-50_000, 50_000), control, draw.randrange(1 << 16))
        yield 0x080, b""
        if draw.random() < 0.9:
            yield 0x183, struct.pack("<ii", draw.randrange(-50_000, 50_000), draw.randrange(-1000, 1000))
    elif kind < 0.75:
        yield from make_sdo(draw, objects)
    elif kind < 0.8:
        yield 0x000, bytes((draw.choice((1, 1, 1, 1, 2, 128, 129, 130, draw.randrange(256))), draw.choice((0, 2, 3))))
    elif kind < 0.85:
        yield 0x701, b"\x05"
    elif kind < 0.9:
        yield draw.choice((0x202, 0x183, 0x080, 0x000, 0x602)), draw.randbytes(draw.randrange(9))
    else:
        yield draw.randrange(0x800), draw.randbytes(draw.randrange(9))


def make_sdo(draw: random.Random, objects: list[tuple[int, int]]) -> Iterator[tuple[int, bytes]]:
    """A request that is mostly well formed: upload, download, both in segments, or random bits."""
    index, sub = draw.choice(objects) if draw.random() < 0.9 else (draw.randrange(1 << 16), draw.randrange(256))
    head = struct.pack("<HB", index, sub)
    kind = draw.random()
    if kind < 0.3:
        yield 0x602, b"\x40" + head + bytes(4)
        for toggle in (0x60, 0x70, 0x60)[:draw.randrange(4)]:
            yield 0x602, bytes((toggle,)) + bytes(7)
    elif kind < 0.7:
        size = draw.randrange(1, 5)
        value = draw.choice((draw.randrange(256), draw.randrange(1 << 32), 0, 1, 255, 0x80000202, 0x202, 100))
        yield 0x602, bytes((0x23 | 4 - size << 2,)) + head + (value & (1 << 8 * size) - 1).to_bytes(4, "little")
    elif kind < 0.9:
        value = struct.pack("<d", draw.choice((3.8, 0.0, 30.0, 1e-3, -1.0, 1e300, float("nan"), float("inf"))))
        announced = draw.choice((8, 8, 8, 0, 7, 9, 1 << 30))
        yield 0x602, (b"\x21" if announced else b"\x20") + head + announced.to_bytes(4, "little")
        yield 0x602, b"\x00" + value[:7]
        yield 0x602, (b"\x1d" if draw.random() < 0.9 else b"\x1b") + value[7:] + bytes(6)
    else:
        yield 0x602, draw.randbytes(8)


def run_in_python(script: list[Frame]) -> list[tuple[int, int, bytes]]:
    """What the built-in firmware sends: time, COB-ID, data."""
    sent: list[tuple[int, int, bytes]] = []
    now = [0]
    firmware = Firmware(lambda cob_id, data: sent.append((now[0], cob_id, data)))
    for frame in script:
        now[0] = frame.t_ns
        if frame.cob_id == TICK:
            firmware.tick(frame.t_ns)
        else:
            firmware.receive(frame)
    return sent


def run_in_c(script: list[Frame]) -> list[tuple[int, int, bytes]]:
    """What the C firmware sends; the sanitizers end it at the first error."""
    sources = [path for path in sorted(FOLDER.glob("*.c")) if path.name not in NEEDS_A_BUS]
    program = build_program("replay", [*sources, SUPPORT / "replay.c"], (*STRICT, *SANITIZERS))
    words = b"".join(RECORD.pack(frame.t_ns, frame.cob_id, len(frame.data), frame.data) for frame in script)
    done = subprocess.run([program], input=words, capture_output=True, timeout=300)
    assert (done.returncode, done.stderr.decode()[-2000:]) == (0, "")
    return [(t_ns, cob_id, data[:length]) for t_ns, cob_id, length, data in RECORD.iter_unpack(done.stdout)]


@pytest.mark.parametrize("seed", range(2))
def test_same_answers_to_a_random_script(seed: int) -> None:
    skip_without_compiler()
    script = make_script(seed, 40_000)
    expected, sent = run_in_python(script), run_in_c(script)
    different = next((k for k, pair in enumerate(zip(expected, sent, strict=False)) if pair[0] != pair[1]), None)
    assert different is None, (expected[different], sent[different])
    assert len(sent) == len(expected)
    kinds = {cob_id for _, cob_id, _ in sent}
    assert kinds >= {0x082, 0x182, 0x582, 0x702}
    currents = {data[:4] for _, cob_id, data in sent if cob_id == 0x182}
    aborts = {data[4:] for _, cob_id, data in sent if cob_id == 0x582 and data[0] == 0x80}
    assert len(currents) > 500 and len(aborts) >= 9

"""The C firmware: the numbers of the built-in one in runs and random frames; each fault built into it is caught."""

import os
import random
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_stations import only_udp, spec, stand_nodes
from c_device import SANITIZERS, STRICT, SUPPORT, build_faulty, needs_compiler, run_program, skip_without_compiler
from log_rows import describe_first_difference
from rig_command import SHORT, answer, job, nodes_on, play, rig, write_file

from plant import InputError, RigError
from rig.firmware.build import FOLDER, build_controller, build_program
from rig.network import PLANT, Frame
from rig.nodes import Firmware
from rig.run import Outcome, participants

WAVES = SHORT.replace('{ name = "back", kind = "ramp", to = 0.0, time = 0.1 },', """
  { kind = "sine", amplitude = 5e-3, frequency = 2.0, time = 0.5 }, { kind = "ramp", to = -2e-3, time = 0.3 },
  { kind = "chirp", amplitude = 1e-3, f0 = 1.0, f1 = 30.0, fade = 20.0, time = 1.0 },""")


@only_udp
@needs_compiler
def test_rows_are_byte_for_byte_those_of_the_builtin_controller(where: str, tmp_path: Path) -> None:
    """On a CAN interface the same is asked in tests/vcan."""
    words = ["run", write_file(tmp_path / "waves.toml", WAVES), "--controller"]
    for more in (["builtin", "--out", tmp_path / "builtin"], ["c", "--bus", where, "--out", tmp_path / "c"]):
        assert answer(*words, *more)["verdict"] == "PASS"
    assert (describe_first_difference(tmp_path / "c", tmp_path / "builtin"), nodes_on(where)) == (
        "none in 2150 rows", [])


@needs_compiler
def test_gains_of_the_model_reach_the_firmware(tmp_path: Path) -> None:
    """With integral and derivative part and the output at its limit: the law has the same bits."""
    gains = {"controller.proportional_gain": 9.0, "controller.integral_gain": 40.0, "controller.derivative_gain": 0.01,
             "controller.current_limit": 2e-3}  # fmt: skip
    play(job(set_=gains, seed=1), tmp_path / "builtin")
    outcome = play(job(set_=gains, seed=1, controller="c", bus=spec("udp_multicast")), tmp_path / "c")
    assert set(outcome.counters.values()) == {0}
    assert describe_first_difference(tmp_path / "c", tmp_path / "builtin").startswith("none in")


@pytest.mark.parametrize(("words", "path", "message"), [
    (["--set", "command_rate_limit.rate=0.05"], None, "builtin"),  # effects in the firmware
    *((["--bus", bus], None, "--bus") for bus in ("virtual", "embedded", "slcan:x")),  # no port for it
    (["--controller", "external", "--bus", "embedded"], None, "on which you start the controller of '"),
    (["--controller", "external", "--plant", "external", "--bus", "virtual"], None, "the controller and plant of '"),
    (["--bus", "udp_multicast"], "/nowhere", "apt-get install gcc"),
])
def test_what_the_firmware_cannot_do_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str],
                                                 path: str | None, message: str) -> None:
    monkeypatch.setenv("PATH", path or os.environ["PATH"])
    answer = rig("run", "--controller", "c", *words, "--out", tmp_path)
    assert answer.status == 2 and message in answer.err and answer.err.count("\n") == 1


@needs_compiler
def test_an_error_of_the_compiler_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "bad.c").write_text("int main(void) { return x; }\n")
    with pytest.raises(RigError) as caught:
        build_program("bad", [tmp_path / "bad.c"], STRICT)
    assert not isinstance(caught.value, InputError) and "error" in str(caught.value) and "\n" not in str(caught.value)


@needs_compiler
@pytest.mark.parametrize("words", [[], ["embedded"], ["socketcan"], ["socketcan:"], ["udp_multicast:x"], ["a", "b"]])
def test_the_program_says_what_it_needs(words: list[str]) -> None:
    done = subprocess.run([build_controller(), *words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr.count("\n") == 1


CAUGHT_BY = {
    "late_frame": "drive frames of another cycle",
    "no_heartbeat": "heartbeat period, controller",
    "leaks_state": "same answers after a reset",
}

# A heartbeat takes 100 ms of wall time, in which lockstep runs through hundreds of cycles.
LONG = SHORT.replace('"rest", kind = "hold", time = 0.05', '"rest", kind = "hold", time = 3.0')


@pytest.fixture(scope="module")
def bus_with_plant() -> Iterator[str]:
    """A bus between programs with a plant that stays on it, as on a real bench."""
    skip_without_compiler()
    where = spec("udp_multicast")
    with stand_nodes(where, PLANT):
        yield where


def play_short(folder: Path, where: str, fault: str, seed: int = 1) -> Outcome:
    """A short run in lockstep against the firmware that is on the bus."""
    text = LONG if fault == "no_heartbeat" else SHORT
    limit = {"slow_start": 1, "no_heartbeat": 1}.get(fault, 20)  # s; a busy machine may need long
    text += f"[timing]\noperational = {limit}\n"
    return play(job(text, seed=seed, controller="external", plant="external", bus=where), folder)


def list_failed(outcome: Outcome) -> list[str]:
    """Names of the checks that did not pass."""
    return [check.name for check in outcome.checks if not check.passed]


# What a program on a bus can change: frames, times and its memory. Other faults are those of firmware_variants.py.
@pytest.mark.parametrize("fault", CAUGHT_BY)
def test_each_fault_is_caught_by_its_check(
    tmp_path: Path, fault: str, bus_with_plant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault == "late_frame":
        monkeypatch.setattr(participants, "FRAME_TIMEOUT", 0.1)  # s: it is spent in each cycle without an answer
    with run_program(build_faulty(), fault, bus_with_plant):
        outcome = play_short(tmp_path, bus_with_plant, fault)
    assert outcome.status == 1
    assert CAUGHT_BY[fault] in list_failed(outcome)


def test_a_firmware_that_is_slow_to_start_is_caught(tmp_path: Path, bus_with_plant: str) -> None:
    """It needs 1.5 s from NMT start to OPERATIONAL."""
    with run_program(build_faulty(), "slow_start", bus_with_plant):
        outcome = play_short(tmp_path, bus_with_plant, "slow_start")
    assert (outcome.verdict, outcome.status) == ("ABORTED", 1)
    assert "node 2 controller must be OPERATIONAL within 1 s of NMT start" in outcome.aborted


@only_udp
@needs_compiler
def test_a_run_under_the_sanitizers_passes(where: str, tmp_path: Path) -> None:
    """The whole program with its port; the first wrong access to memory would end it.

    Not in the guest, whose kernel has no room for the sanitizer's shadow memory.
    """
    program = build_program("controller", sorted(FOLDER.glob("*.c")), (*STRICT, *SANITIZERS))
    with run_program(program, where):
        outcome = play(job(f"{SHORT}[timing]\noperational = 20\n", seed=1, controller="external", bus=where), tmp_path)
    assert (outcome.verdict, list_failed(outcome)) == ("PASS", [])


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
        announced_size = draw.choice((8, 8, 8, 0, 7, 9, 1 << 30))
        yield 0x602, (b"\x21" if announced_size else b"\x20") + head + announced_size.to_bytes(4, "little")
        yield 0x602, b"\x00" + value[:7]
        yield 0x602, (b"\x1d" if draw.random() < 0.9 else b"\x1b") + value[7:] + bytes(6)
    else:
        yield 0x602, draw.randbytes(8)


def run_in_python(script: list[Frame]) -> list[tuple[int, int, bytes]]:
    """What the built-in firmware sends: time, COB-ID, data."""
    frames: list[tuple[int, int, bytes]] = []
    now = [0]
    firmware = Firmware(lambda cob_id, data: frames.append((now[0], cob_id, data)))
    for frame in script:
        now[0] = frame.t_ns
        if frame.cob_id == TICK:
            firmware.tick(frame.t_ns)
        else:
            firmware.receive(frame)
    return frames


def run_in_c(script: list[Frame]) -> list[tuple[int, int, bytes]]:
    """What the C firmware sends; the sanitizers end it at the first error."""
    sources = [path for path in sorted(FOLDER.glob("*.c")) if path.name not in NEEDS_A_BUS]
    program = build_program("replay", [*sources, SUPPORT / "replay.c"], (*STRICT, *SANITIZERS))
    words = b"".join(RECORD.pack(frame.t_ns, frame.cob_id, len(frame.data), frame.data) for frame in script)
    done = subprocess.run([program], input=words, capture_output=True, timeout=300)
    assert (done.returncode, done.stderr.decode()[-2000:]) == (0, "")
    return [(t_ns, cob_id, data[:length]) for t_ns, cob_id, length, data in RECORD.iter_unpack(done.stdout)]


@needs_compiler
@pytest.mark.parametrize("seed", range(2))
def test_same_answers_to_a_random_script(seed: int) -> None:
    script = make_script(seed, 40_000)
    python_frames, c_frames = run_in_python(script), run_in_c(script)
    different = next((k for k, pair in enumerate(zip(python_frames, c_frames, strict=False)) if pair[0] != pair[1]),
                     None)
    assert different is None, (python_frames[different], c_frames[different])
    assert len(c_frames) == len(python_frames)
    assert {cob_id for _, cob_id, _ in c_frames} >= {0x082, 0x182, 0x582, 0x702}
    currents = {data[:4] for _, cob_id, data in c_frames if cob_id == 0x182}
    aborts = {data[4:] for _, cob_id, data in c_frames if cob_id == 0x582 and data[0] == 0x80}
    assert len(currents) > 500 and len(aborts) >= 9

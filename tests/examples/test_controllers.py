"""The controllers of examples/, as canopen, cantools and the rig see them: the sound ones pass, no faulty one does."""

import re
import subprocess
from functools import partial
from itertools import product
from pathlib import Path

import canopen
import pytest
from broken_devices import list_cases
from bus_stations import spec
from c_device import needs_compiler
from example_devices import DRIVE, ECU, PATIENT, DriveHarness, EcuHarness, make_drive, run_device
from node_bench import MS
from rig_command import SHORT, SLOW_START, CommandResult, rig, write_file

from rig.conformance.run_cases import run_cases
from rig.conformance.target import DataSheet, Options, Target
from rig.firmware.build import build_device
from rig.network import EmbeddedWire, VirtualClock
from rig.run import participants

OFF, SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, RESET = 0x00, 0x06, 0x07, 0x0F, 0x02, 0x80
DISABLED, READY, SWITCHED_ON, ENABLED = "SWITCH ON DISABLED", "READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"
STOPPED, REACTION, FAULT = "QUICK STOP ACTIVE", "FAULT REACTION ACTIVE", "FAULT"


@pytest.fixture
def drive() -> DriveHarness:
    """A drive that is OPERATIONAL in mode 8, and its master."""
    harness = DriveHarness()
    harness.start()
    return harness


@pytest.mark.parametrize(("controls", "states"), [
    ([OFF], [DISABLED]),  # 0, 1
    ([SWITCH_ON, ENABLE], [DISABLED, DISABLED]),
    ([SHUTDOWN, SWITCH_ON, ENABLE], [READY, SWITCHED_ON, ENABLED]),  # 2, 3, 4
    ([SHUTDOWN, ENABLE], [READY, ENABLED]),  # 3 and 4 at once
    ([SHUTDOWN, ENABLE, SWITCH_ON, SHUTDOWN], [READY, ENABLED, SWITCHED_ON, READY]),  # 5, 6
    ([SHUTDOWN, OFF], [READY, DISABLED]),  # 7
    ([SHUTDOWN, QUICK_STOP], [READY, DISABLED]),  # 7
    ([SHUTDOWN, ENABLE, SHUTDOWN], [READY, ENABLED, READY]),  # 8
    ([SHUTDOWN, ENABLE, OFF], [READY, ENABLED, DISABLED]),  # 9
    ([SHUTDOWN, SWITCH_ON, OFF], [READY, SWITCHED_ON, DISABLED]),  # 10
    ([SHUTDOWN, SWITCH_ON, QUICK_STOP], [READY, SWITCHED_ON, DISABLED]),  # 10
    ([SHUTDOWN, ENABLE, QUICK_STOP, QUICK_STOP], [READY, ENABLED, STOPPED, DISABLED]),  # 11, 12
    ([SHUTDOWN, ENABLE, RESET], [READY, ENABLED, ENABLED]),  # no fault to reset
])
def test_each_transition(drive: DriveHarness, controls: list[int], states: list[str]) -> None:
    """Control words from SWITCH ON DISABLED on, and the states that they lead to."""
    assert drive.cycle(OFF).state == DISABLED
    assert [drive.cycle(control).state for control in controls] == states


@pytest.mark.parametrize(("target", "position", "current"), [
    (1000, 0.5, 95),  # 3.8 A/m over 0.5 mm is 1.9 mA, 95 per mille of 20 mA
    (-1000, 0.5, -285),
    (0, -0.0101, 2),  # 38 uA: 1.9 counts
    (100_000, 0.0, 400),
    (-2_147_483_648, 1e30, -400),
])
def test_current_follows_the_error_up_to_its_limit(drive: DriveHarness, target: int, position: float, current: int
                                                   ) -> None:
    answer = drive.enable(target, position)
    assert (answer.current, bool(answer.status & 0x800)) == (current, abs(current) == 400)


def test_what_it_does_not_know_is_refused(drive: DriveHarness) -> None:
    modes, code, gain = drive.sdo[0x6060], drive.sdo[0x605A], drive.sdo[0x2002][1]
    writes = [*((modes, mode) for mode in (-1, 1, 3, 6, 7, 9)), (code, 3), (code, 5), (gain, float("nan")),
              (gain, -1.0)]
    for leaf, value in writes:
        before = leaf.raw
        with pytest.raises(canopen.SdoAbortedError) as caught:
            leaf.raw = value
        assert caught.value.code == 0x06090030 and leaf.raw == before  # value range


@pytest.mark.parametrize("number", [1, 2])
def test_a_missing_rpdo_is_a_fault(drive: DriveHarness, number: int) -> None:
    drive.enable(target=1000)
    answers = [drive.cycle(silent=(number,)) for _ in range(5)]
    assert [answer.state for answer in answers] == [ENABLED, ENABLED, ENABLED, REACTION, FAULT]
    assert [answer.current for answer in answers] == [190, 190, 190, 0, 0]
    assert drive.last_emergency() == (0x8250, number) and drive.sdo[0x603F].raw == 0x8250
    drive.sdo[0x6040].raw = RESET
    assert drive.cycle(RESET, silent=(number,)).state == FAULT  # the cause is still there
    assert drive.cycle(RESET).state == FAULT  # no rising edge
    assert drive.last_emergency()[0] == 0
    assert [drive.cycle(control).state for control in (ENABLE, RESET, SHUTDOWN, ENABLE)] == (
        [FAULT, DISABLED, READY, ENABLED])
    assert drive.sdo[0x603F].raw == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_position_that_is_no_number_is_a_fault(drive: DriveHarness, value: float) -> None:
    drive.enable(target=1000)
    assert drive.cycle(position=value)[:2] == (REACTION, 0)
    assert drive.last_emergency()[0] == 0x7300
    assert drive.cycle(position=0.0)[:2] == (FAULT, 0)
    assert [drive.cycle(control).state for control in (OFF, RESET)] == [FAULT, DISABLED]


def test_lost_sync_is_a_fault(drive: DriveHarness) -> None:
    drive.enable(target=1000)
    drive.sdo[0x1006].raw = 1000  # us
    drive.cycle()
    drive.wait(20 * MS)
    assert drive.last_emergency()[0] == 0x8100 and drive.sdo[0x603F].raw == 0x8100
    assert drive.sdo[0x6078].raw == 0 and drive.cycle()[:2] == (FAULT, 0)


def test_a_lost_master_is_a_fault(drive: DriveHarness) -> None:
    drive.sdo[0x1016][1].raw = 1 << 16 | 50  # node 1, ms
    drive.enable(target=1000)
    drive.send(0x701, b"\x05")
    drive.wait(60 * MS)
    assert drive.last_emergency() == (0x8130, 1)
    assert drive.sdo[0x6078].raw == 0 and drive.sdo[0x6041].raw & 0x4F == 0x08


def test_it_conforms_to_cia_301() -> None:
    wire = EmbeddedWire(VirtualClock(), [partial(make_drive, node=17)])
    outcome = run_cases(Target(wire, DataSheet(DRIVE / "drive.eds", 17), Options(may_write=True)))
    assert (outcome.verdict, list_cases(outcome)) == ("PASS", [])


INIT, SYNCHRONISING, OPERATIONAL, ECU_FAULT = 1, 2, 3, 4


@pytest.fixture
def ecu() -> EcuHarness:
    """An ECU in state 3."""
    harness = EcuHarness()
    harness.start()
    return harness


def read(answer: dict[str, float]) -> tuple[float, float]:
    """State and current, mA."""
    return answer["State"], answer["Current"]


def test_without_frames_it_says_every_10_ms_that_it_is_there() -> None:
    ecu = EcuHarness()
    for _ in range(195):
        ecu.wait(MS)
    drives = ecu.decode([data for _, _, data in ecu.heard])
    assert {read(drive) for drive in drives} == {(INIT, 0.0)}
    assert [int(drive["Counter"]) for drive in drives] == [k % 16 for k in range(20)]


def test_five_sound_frames_make_it_operational() -> None:
    ecu = EcuHarness()
    assert [ecu.cycle(enable=0)["State"] for _ in range(6)] == [SYNCHRONISING] * 4 + [OPERATIONAL] * 2


@pytest.mark.parametrize(("target", "position", "current"), [
    (1.0, 0.5, 1.8), (-1.0, 0.5, -5.4), (5.0, 0.0, 8.0), (-5.0, 0.0, -8.0), (0.0, 0.00123, -0.004),
    (-8388.608, 1342.17727, -8.0),  # the ends of the ranges
])
def test_current_of_the_ecu_follows_the_error_up_to_its_limit(ecu: EcuHarness, target: float, position: float,
                                                              current: float) -> None:
    """3.6 A/m; the derivative part is 0 in the first cycle with a current and while nothing changes."""
    ecu.cycle(target, position, enable=0)
    assert [read(ecu.cycle(target, position)) for _ in range(2)] == [pytest.approx((OPERATIONAL, current))] * 2


@pytest.mark.parametrize(("name", "kind"), list(product(("Demand", "Feedback"), ("checksum", "counter"))))
def test_wrong_frames_are_not_used_and_three_are_a_fault(ecu: EcuHarness, name: str, kind: str) -> None:
    ecu.cycle(1.0, 0.5)
    answers = []
    for _ in range(3):
        frames = {"Demand": {"Position": 1.0, "Enable": 1}, "Feedback": {"Position": 0.5, "Pressure": 0}}
        frames[name]["Position"] = -3.0
        if kind == "counter":
            ecu.counters[name] -= 1
        for each, values in frames.items():
            data = ecu.encode(each, **values)
            is_spoilt = (each, kind) == (name, "checksum")
            drives = ecu.transmit(each, bytes((data[0] ^ is_spoilt, *data[1:])))
        answers += map(read, drives)
    assert answers == [(OPERATIONAL, 1.8), (OPERATIONAL, 1.8), (ECU_FAULT, 0.0)]
    assert [ecu.cycle(enable=0)["State"] for _ in range(10)][-1] == OPERATIONAL  # its counters begin anew


def test_when_the_frames_stop_the_current_does(ecu: EcuHarness) -> None:
    assert [read(ecu.cycle(1.0, 0.5)) for _ in range(2)] == [(OPERATIONAL, 1.8)] * 2
    ecu.heard.clear()
    for _ in range(120):  # ms; the fault comes after 100
        ecu.wait(MS)
    (last,) = ecu.decode([ecu.heard[-1][2]])
    assert read(last) == (ECU_FAULT, 0.0)
    assert [ecu.cycle(enable=0)["State"] for _ in range(5)][-1] == OPERATIONAL


IN_TIME = """
[protocol]
missing = 0.1
response_p50 = 1.0
response_p99 = 1.0
response_max = 1.0
"""  # in real time: on a busy machine an answer comes late
TRIES = 3  # in real time, on a machine that may be busy
examples = pytest.mark.parametrize("folder", [DRIVE, ECU], ids=lambda folder: folder.name)


def run_bench(folder: Path, where: str, out: Path, *words: object, options: tuple[str, ...] = ()) -> CommandResult:
    """Run a sequence, preflight unless `words` begin with another one, against an example on a bus."""
    with run_device(folder, where, *options):
        return rig("run", *words, "--bench", folder / "bench.toml", "--bus", where, "--json", "--out", out)


def list_failed(result: CommandResult) -> list[str]:
    """Names of the checks that failed."""
    return [check["name"] for check in result.json["checks"] if not check["passed"]]


# without set-up and clean-up: the probe switches the controller off in the middle of a step
BARE = re.sub("(setup|cleanup) .*", "", SHORT).replace('"ramp", to = 0.0, time = 0.1', '"step", to = 0.0, time = 0.03'
                                                       ) + SLOW_START


@pytest.mark.parametrize(("folder", "text"), [
    (DRIVE, SHORT + SLOW_START), pytest.param(ECU, "", marks=pytest.mark.slow), (ECU, BARE),
    (ECU, BARE.replace("0.03 ", "0.031 ")), (ECU, BARE + "[protocol]\nprobe = false\n")])
def test_a_sequence_passes_in_lockstep(tmp_path: Path, folder: Path, text: str) -> None:
    """Both pass a whole preflight, the drive in test_any_plant.py, if slow tests are asked for."""
    words = (write_file(tmp_path / "short.toml", text),) if text else ()  # preflight
    result = run_bench(folder, spec("udp_multicast"), tmp_path, *words, options=PATIENT[folder])
    assert (result.status, result.json["verdict"], list_failed(result)) == (0, "PASS", [])


OWN_CHECKSUM = '''
def add_up(data, counter):
    crc = 0xFF
    for byte in data[1:]:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ INVERSION
'''


def test_a_checksum_of_the_users_own_protects_a_whole_run(tmp_path: Path) -> None:
    """Sent and checked in compiled cycles; without --trust one line; with another result the ECU hears nothing."""
    bench = (ECU / "bench.toml").read_text().replace('"crc8_sae_j1850"', '"own.py:add_up"')
    where, words = spec("udp_multicast"), ("--bench", tmp_path / "bench.toml", "--out", tmp_path / "run", "--json")
    (tmp_path / "bench.toml").write_text(bench)
    (tmp_path / "ecu.dbc").write_bytes((ECU / "ecu.dbc").read_bytes())
    (tmp_path / "short.toml").write_text(SHORT + SLOW_START)
    (tmp_path / "own.py").write_text(OWN_CHECKSUM.replace("INVERSION", "255"))
    result = rig("run", tmp_path / "short.toml", *words, "--bus", where)
    assert result.status == 2 and result.err.count("own.py") == 1 and result.err.count("\n") == 1
    for inversion, verdict in ((255, "PASS"), (254, "ABORTED")):
        (tmp_path / "own.py").write_text(OWN_CHECKSUM.replace("INVERSION", str(inversion)))
        with run_device(ECU, where, *PATIENT[ECU]):
            result = rig("run", tmp_path / "short.toml", *words, "--bus", where, "--trust")
        assert result.json["verdict"] == verdict and result.err.count("own.py") == 1, result.err


@examples
def test_a_short_run_passes_in_real_time(tmp_path: Path, folder: Path) -> None:
    words = (write_file(tmp_path / "short.toml", SHORT + SLOW_START + IN_TIME), "--pace", "realtime")
    for k in range(TRIES):
        result = run_bench(folder, spec("udp_multicast"), tmp_path / str(k), *words)
        if result.json["verdict"] not in ("ABORTED", "INVALID_TIMING"):
            assert (result.status, result.json["verdict"], list_failed(result)) == (0, "PASS", [])
            return
    pytest.skip(f"the machine was too busy for {TRIES} runs in real time: {result.json['verdict']}")


STEP = SHORT.replace("to = 1e-3", "to = 5e-3") + SLOW_START  # takes the current to its limit
LATER = SHORT.replace("time = 0.1 }", "time = 1.5 }") + SLOW_START  # some faults begin after a second
FOUND_BY = {  # fault: by what, and in which sequence; "" for preflight
    "wrong_sign": ("guard 'ram far out'", ""), "wrong_scaling": ("current within its limit", STEP),
    "ignores_enable": ("no current unless", STEP), "stops_sending": ("no valid drive frame", LATER),
    "stuck_status": ("status word follows", STEP), "wrong_counter": ("the last that came had the alive counter", LATER)}


@pytest.mark.parametrize(("folder", "fault"), [
    *((DRIVE, fault) for fault in FOUND_BY if fault != "wrong_counter"),
    *((ECU, fault) for fault in ("ignores_enable", "stops_sending", "wrong_counter"))])
def test_a_faulty_controller_does_not_pass(tmp_path: Path, folder: Path, fault: str,
                                           monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(participants, "FRAME_TIMEOUT", 0.2)  # s: it is spent in each cycle without an answer
    found_by, text = FOUND_BY[fault]
    words = (write_file(tmp_path / "step.toml", text),) if text else ()
    result = run_bench(folder, spec("udp_multicast"), tmp_path, *words, options=("--fault", fault, *PATIENT[folder]))
    cause = (result.json.get("cause") or {}).get("text", "")
    assert result.status == 1 and result.json["verdict"] in ("FAIL", "ABORTED")
    assert any(re.search(found_by, text) for text in [*list_failed(result), cause]), (list_failed(result), cause)


@needs_compiler
@pytest.mark.parametrize(("folder", "line"), [
    *((DRIVE, line) for line in ("", "--node", "B --node 0", "B --node 128", "B --fault x", "B --other 1")),
    *((ECU, line) for line in ("", "--timeout", "B --timeout 0", "B --fault x"))])
def test_a_wrong_command_line_is_one_line(folder: Path, line: str) -> None:
    done = subprocess.run([build_device(folder), *line.split()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr.count("\n") == 1


@examples
def test_the_page_names_each_fault(folder: Path) -> None:
    """What the page of an example lists is what its program takes."""
    names = re.search(r"NAMES\[\] = \{(.*?)\}", (folder / "faults.c").read_text(), re.DOTALL)
    assert names is not None
    page = (folder / "README.md").read_text()
    assert [name for name in re.findall(r'"(\w+)"', names[1])[1:] if f"`{name}`" not in page] == []

"""The rig tests the controllers of examples/ by their bench files: the sound ones pass, and none of the faulty ones."""

import re
import subprocess
from pathlib import Path

import pytest
from bus_stations import spec
from c_device import skip_without_compiler
from example_devices import DRIVE, ECU, PATIENT, run_device
from rig_command import SHORT, SLOW_START, Said, rig

from rig.firmware.build import build_device
from rig.run import participants

IN_TIME = """
[protocol]
missing = 0.1
response_p50 = 1.0
response_p99 = 1.0
response_max = 1.0
"""  # in real time: on a busy machine an answer comes late
TRIES = 3  # in real time, on a machine that may be busy
examples = pytest.mark.parametrize("folder", [DRIVE, ECU], ids=lambda folder: folder.name)


def run_bench(folder: Path, where: str, out: Path, *words: object, options: tuple[str, ...] = ()) -> Said:
    """Run a sequence, preflight unless `words` begin with another one, against an example on a bus."""
    with run_device(folder, where, *options):
        return rig("run", *words, "--bench", folder / "bench.toml", "--bus", where, "--json", "--out", out)


def list_failed(said: Said) -> list[str]:
    """Names of the checks that failed."""
    return [check["name"] for check in said.json["checks"] if not check["passed"]]


@examples
def test_preflight_passes_in_lockstep(tmp_path: Path, folder: Path) -> None:
    said = run_bench(folder, spec("udp_multicast"), tmp_path, options=PATIENT[folder])
    assert (said.status, said.json["verdict"], list_failed(said)) == (0, "PASS", [])


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
    for inversion, trust, status in ((0xFF, (), 2), (0xFF, ("--trust",), 0), (0xFE, ("--trust",), 1)):
        (tmp_path / "own.py").write_text(OWN_CHECKSUM.replace("INVERSION", str(inversion)))
        with run_device(ECU, where, *PATIENT[ECU]):
            said = rig("run", tmp_path / "short.toml", *words, "--bus", where, *trust)
        assert said.status == status, said.err
        assert said.err.count("own.py") == 1 and said.err.count("\n") == 1 + (status == 1)  # refused, or announced
    assert said.json["verdict"] == "ABORTED"


@examples
def test_a_short_run_passes_in_real_time(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "short.toml").write_text(SHORT + SLOW_START + IN_TIME)
    for k in range(TRIES):
        words = (tmp_path / "short.toml", "--pace", "realtime")
        said = run_bench(folder, spec("udp_multicast"), tmp_path / str(k), *words)
        if said.json["verdict"] not in ("ABORTED", "INVALID_TIMING"):
            assert (said.status, said.json["verdict"], list_failed(said)) == (0, "PASS", [])
            return
    pytest.skip(f"the machine was too busy for {TRIES} runs in real time: {said.json['verdict']}")


STEP = SHORT.replace("to = 1e-3", "to = 5e-3") + SLOW_START  # takes the current to its limit
LATER = SHORT.replace("time = 0.1 }", "time = 1.5 }") + SLOW_START  # some faults begin after a second
FOUND_BY = {  # fault: by what, and in which sequence; "" for preflight
    "wrong_sign": ("guard 'ram far out'", ""), "wrong_scaling": ("current within its limit", STEP),
    "ignores_enable": ("no current unless", STEP), "stops_sending": ("no drive frame", LATER),
    "stuck_status": ("status word follows", STEP), "wrong_counter": ("no drive frame", LATER)}


@pytest.mark.parametrize(("folder", "fault"), [
    *((folder, fault) for folder in (DRIVE, ECU) for fault in (
        "wrong_sign", "wrong_scaling", "ignores_enable", "stops_sending")),
    (DRIVE, "stuck_status"), (ECU, "wrong_counter")])
def test_a_faulty_controller_does_not_pass(tmp_path: Path, folder: Path, fault: str,
                                           monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(participants, "FRAME_TIMEOUT", 0.2)  # s: it is spent in each cycle without an answer
    found_by, text = FOUND_BY[fault]
    (tmp_path / "step.toml").write_text(text)
    words = (tmp_path / "step.toml",) if text else ()
    said = run_bench(folder, spec("udp_multicast"), tmp_path, *words, options=("--fault", fault, *PATIENT[folder]))
    cause = (said.json.get("cause") or {}).get("text", "")
    assert said.status == 1 and said.json["verdict"] in ("FAIL", "ABORTED")
    assert any(re.search(found_by, text) for text in [*list_failed(said), cause]), (list_failed(said), cause)


@pytest.mark.parametrize(("folder", "line"), [
    *((DRIVE, line) for line in ("", "--node", "B --node 0", "B --node 128", "B --fault x", "B --other 1")),
    *((ECU, line) for line in ("", "--timeout", "B --timeout 0", "B --fault x"))])
def test_a_wrong_command_line_is_one_line(folder: Path, line: str) -> None:
    skip_without_compiler()
    done = subprocess.run([build_device(folder), *line.split()], capture_output=True, text=True, timeout=20)
    assert done.returncode == 2 and done.stderr.count("\n") == 1


def test_the_page_names_each_fault() -> None:
    """What the page of an example lists is what its program takes."""
    for folder in (DRIVE, ECU):
        names = re.search(r"NAMES\[\] = \{(.*?)\}", (folder / "faults.c").read_text(), re.DOTALL)
        assert names is not None
        page = (folder / "README.md").read_text()
        assert [name for name in re.findall(r'"(\w+)"', names[1])[1:] if f"`{name}`" not in page] == []

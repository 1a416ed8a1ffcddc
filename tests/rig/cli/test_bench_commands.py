"""`rig check --bench`, `rig new bench`, `rig doctor --bench` and docs/bench.md."""

import math
import re
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import pytest
from device_files import BENCH, write_bench
from places import ROOT
from rig_command import refuse, rig, write_file

from plant import EHA
from rig.benches import UNSURE, Role, Wanted, guess_can, load_bench, pack
from rig.benches.bench import list_inputs, list_outputs
from rig.benches.bench_file import ControllerKeys, NodeKeys
from rig.benches.checksums import CHECKSUMS
from rig.doctor import count_frames, judge_frames
from rig.network import Frame, Link, WallClock, open_can

PLANT = ROOT / "tests" / "support" / "trim_jack.py"
PAGE = (ROOT / "docs" / "bench.md").read_text()
DRIVE, ECU = ROOT / "examples" / "cia402_drive", ROOT / "examples" / "can_ecu"
SHEETS = {"drive": DRIVE / "drive.eds", "ecu": ECU / "ecu.dbc", "eha": ROOT / "dbc" / "node2.eds",
          "eha_on_can": ROOT / "dbc" / "eha.dbc"}


def test_the_frames_of_the_shipped_bench_load_the_bus_as_the_page_of_the_bus_says() -> None:
    answer = rig("check", "--bench", "eha", "--json").json["bench"]
    cyclic = [each for each in answer["frames"] if not each["name"].startswith("heartbeat")]
    assert sum(each["share"] for each in cyclic) == pytest.approx((4 * 135 + 55) / 1000)  # docs/bus.md, Load
    assert answer["nodes"] == {"controller": 2, "plant": 3}
    assert answer["frames"][0]["signals"] == ["position_demand", "control_word", "cycle"]
    result = rig("check", "--bench", "eha")
    assert result.status == 0 and "RPDO1" in result.out and "0x202" in result.out and "WITHIN_LIMITS" in result.out


def test_a_bus_that_is_too_slow_is_reported(tmp_path: Path) -> None:
    slow = write_bench(tmp_path, BENCH.replace("[controller]", "bitrate = 125_000\n[controller]", 1))
    result = rig("check", "--bench", slow)
    assert result.status == 1 and "BEYOND_LIMITS" in result.out and "The frames need" in result.out


def test_a_sequence_is_checked_together_with_a_bench(tmp_path: Path) -> None:
    answer = rig("check", "preflight", "--bench", ECU / "bench.toml", "--json").json
    assert answer["bench"]["protocol"] == "can" and answer["demands"]
    assert "expected a SEQUENCE, --bench FILE, or both" in refuse("check")
    assert "a file that can be read" in refuse("check", "--bench", tmp_path / "none.toml")
    assert "main[1]: expected demands from -0.00214748 to 0.00214748 m, which frame RPDO1 of 'a drive' can" in refuse(
        "check", "preflight", "--bench", write_bench(tmp_path, BENCH.replace('"1 um"', '"0.001 nm"')))


@pytest.mark.parametrize("name", SHEETS)
def test_a_new_bench_can_be_used_or_says_what_is_missing(name: str, here: Path) -> None:
    sheet = Path(shutil.copy(SHEETS[name], here)).name
    answer = rig("new", "bench", name, "--eds" if sheet.endswith("eds") else "--dbc", sheet, "--json").json
    assert answer["verdict"] == "COMPLETE" and Path(f"{name}.toml").exists()
    assert rig("check", "--bench", f"{name}.toml").status == 0
    bench = load_bench(f"{name}.toml")
    assert {"position_demand", "ram_position"} <= {each.name for spec in bench.frames.list_from(Role.RIG)
                                                   for each in spec.fields}
    assert answer["unsure"] == [line.strip() for line in Path(f"{name}.toml").read_text().splitlines()
                                if UNSURE in line]
    assert "a file that does not exist yet" in refuse("new", "bench", name, "--eds", sheet)


@pytest.mark.parametrize(("name", "option", "words"), [("drive", "--eds", ("--node", 5)), ("ecu", "--dbc", ())])
def test_the_guess_of_an_example_is_the_example(name: str, option: str, words: tuple[object, ...], tmp_path: Path
                                                ) -> None:
    """For the frames; what the data sheet cannot say is marked."""
    path, sheet = tmp_path / f"{name}.toml", SHEETS[name]
    assert rig("new", "bench", name, option, sheet, *words, "--out", path).status == 0
    guess, bench = load_bench(str(path)), load_bench(str(sheet.parent / "bench.toml"))
    assert (repr(guess.frames), guess.phases, guess.ready) == (repr(bench.frames), bench.phases, bench.ready)


TRIM_DBC = """VERSION ""
BU_: ECU RIG
BO_ 256 Command: 4 RIG
 SG_ TrimCmd : 0|16@1- (0.01,0) [-100|100] "deg" ECU
BO_ 257 Feedback: 8 RIG
 SG_ TrimAngle : 0|32@1- (1,0) [0|0] "urad" ECU
 SG_ ShaftRate : 32|32@1- (0.01,0) [0|0] "1/min" ECU
BO_ 512 Drive: 4 ECU
 SG_ TorqueRef : 0|32@1- (1,0) [0|0] "mNm" RIG
"""


def test_a_bench_of_an_own_plant_is_guessed_from_its_signals(tmp_path: Path) -> None:
    """A plant may declare units of its own, such as deg, and the device others of the same quantity."""
    (tmp_path / "trim.dbc").write_text(TRIM_DBC)
    (tmp_path / "jack.py").write_text(PLANT.read_text().replace('"tc", "rad"', '"tc", "deg"'))
    result = rig("new", "bench", "trim", "--dbc", tmp_path / "trim.dbc", "--model", tmp_path / "jack.py",
                 "--out", tmp_path / "trim.toml")
    assert result.status == 0 and "COMPLETE" in result.out and "trim.toml --trust" in result.out
    bench = load_bench(str(tmp_path / "trim.toml"))
    counts = {each.name: each.count for spec in bench.frames.frames for each in spec.fields}
    assert {name: float(count) for name, count in counts.items()} == pytest.approx({
        "trim_cmd": 0.01, "trim_angle": 1e-6, "shaft_rate": 0.01 * math.pi / 30.0, "torque_ref": 1e-3})
    assert "expected no device" in refuse("new", "plant", "x", "--model", "ema")


BOX_DBC = """VERSION ""
BU_: HOST BOX
BO_ 528 Soll: 8 HOST
 SG_ Soll_Weg : 15|24@0+ (0.00073,-37.5) [0|0] "mm" BOX
 SG_ Soll_Reserve : 39|8@0+ (1,0) [0|255] "" BOX
BO_ 529 Ist: 8 HOST
 SG_ Ist_Weg : 15|28@0- (0.00011,3.3) [0|0] "mm" BOX
 SG_ Ist_Druck : 35|16@0+ (0.013,-400) [0|0] "bar" BOX
BO_ 774 Antwort: 4 BOX
 SG_ Antwort_Takt : 11|4@0+ (1,0) [0|14] "" HOST
 SG_ Antwort_Strom : 23|12@0+ (0.0041,-8.405) [0|0] "mA" HOST
"""


@pytest.mark.parametrize(("name", "message"), [
    ("Strom", 'current = "Antwort.Antwort_Strom"'), ("Wert", "nothing looks like it")])
def test_german_names_are_known_and_what_the_rig_sends_is_no_output(name: str, message: str) -> None:
    """Also where the current's name says nothing: then the device is who does not send the demand."""
    text = guess_can("box", "box.dbc", BOX_DBC.replace("Strom", name), Wanted())
    inputs, outputs = text.split("[controller.outputs]")
    assert all(f'{word} = "{signal}"' in inputs for word, signal in (
        ("position_demand", "Soll.Soll_Weg"), ("ram_position", "Ist.Ist_Weg"), ("load_pressure", "Ist.Ist_Druck")))
    assert message in outputs and "Antwort" not in inputs and "Soll" not in outputs


def test_a_sheet_without_the_signals_is_completed_by_the_user(tmp_path: Path) -> None:
    write_bench(tmp_path)
    result = rig("new", "bench", "x", "--eds", tmp_path / "x.eds", "--out", tmp_path / "new.toml")
    assert result.status == 0 and "is to be completed" in result.out and "nothing looks like it" in result.out
    for words in ((), ("--eds", "a.eds", "--dbc", "b.dbc")):
        assert "expected --eds FILE" in refuse("new", "bench", "y", *words)
    assert "expected 1 to 127" in refuse("new", "bench", "y", "--eds", tmp_path / "x.eds", "--node", "128")
    assert "a DBC" in refuse("new", "bench", "y", "--dbc", tmp_path / "x.eds", "--out", tmp_path / "y.toml")


def test_the_doctor_listens_for_a_bench() -> None:
    spec, bench = "udp_multicast:239.74.163.93", load_bench(str(ECU / "bench.toml"))
    drive, demand = (bench.frames.list_from(role)[0] for role in (Role.CONTROLLER, Role.RIG))
    stop = threading.Event()

    def send(link: Link) -> None:
        while not stop.wait(0.002):
            for identifier, data in ((drive.identifier, pack(drive, {})), (drive.identifier, b"12"), (0x123, b""),
                                     (demand.identifier, pack(demand, {}))):
                link.send(identifier, data)

    silent = rig("doctor", "--bench", ECU / "bench.toml", "--bus", spec, "--seconds", "0.2")
    assert silent.status == 1 and "Nothing of the controller is heard" in silent.out
    (drive_frame,) = (each for each in judge_frames(bench, *count_frames(bench, []), 1.0) if "Drive" in each.name)
    assert "power, wiring, bit rate" in drive_frame.remedy and "only answers the rig" in drive_frame.remedy
    eha = load_bench("eha")
    beating = judge_frames(eha, *count_frames(eha, [Frame(0, 0x702, b"\x05")]), 1.0)
    remedies = {each.name.split()[0]: each.remedy for each in beating}
    assert remedies["TPDO1"] == "PDOs come after NMT start" and "power" in remedies["plant"]
    with closing(Link(open_can(spec), WallClock().now)) as link, ThreadPoolExecutor() as pool:
        sender = pool.submit(send, link)
        try:
            result = rig("doctor", "--bench", ECU / "bench.toml", "--bus", spec, "--seconds", "1", "--json")
        finally:
            stop.set()
            sender.result()  # raises what went wrong in it
    findings = {each["name"].split()[0]: each for each in result.json["findings"]}
    assert findings["Drive"]["status"] == "limited"
    assert f"some of 2 bytes, not {drive.length}" in findings["Drive"]["found"]
    assert "another rig" in findings["Demand"]["remedy"] and findings["Feedback"]["found"] == "none; the rig sends it"
    assert findings["other"]["found"].startswith("0x123 (")


def test_every_key_signal_and_checksum_is_on_the_page() -> None:
    for each in (*fields(ControllerKeys), *fields(NodeKeys)):
        assert re.search(rf"\b{each.name}\b", PAGE), each.name
    for name in (*list_inputs(EHA), *list_outputs(EHA), *CHECKSUMS):
        assert f"`{name}`" in PAGE, name


def test_the_examples_on_the_page_are_valid(tmp_path: Path) -> None:
    blocks = [re.sub("^    ", "", block, flags=re.MULTILINE) for block in re.findall(r"(?:^(?:    .*)?\n)+", PAGE,
                                                                                    re.MULTILINE)]
    canopen = next(block for block in blocks if 'eds = "drive_x.eds"' in block)
    can = 'name = "x"\n' + next(block for block in blocks if 'dbc = "ecu.dbc"' in block)
    shutil.copy(DRIVE / "drive.eds", tmp_path / "drive_x.eds")
    shutil.copy(ECU / "ecu.dbc", tmp_path / "ecu.dbc")
    for text in (canopen, can):
        bench = load_bench(str(write_file(tmp_path / "b.toml", text)))
        assert len(bench.frames.frames) >= 3

"""Bench files: the shipped bench, the examples, what a log repeats, and one line for each mistake."""

from fractions import Fraction
from pathlib import Path

import pytest
from codec import SIGNALS, SYNC, Signal
from device_files import BENCH, OBJECTS, RPDOS, TPDOS, Entry, Mapped, format_eds, write_bench
from places import ROOT
from refusals import catch_refusal

from dbc import EDS
from rig.benches import Role, load_bench, load_bench_from_files, pack
from rig.benches.bench import Kind, Protection
from rig.benches.bench_file import list_benches

EXAMPLES = sorted(ROOT.glob("examples/*/bench.toml"))


def test_the_shipped_bench_has_the_frames_of_the_codec() -> None:
    bench = load_bench()
    signals = [Signal(spec.identifier, each.name, each.lowest, each.length, each.kind is Kind.SIGNED, float(each.count),
                      {"position_demand": "m", "ram_position": "m", "spool_position": "m", "load_pressure": "Pa",
                       "current": "A"}.get(each.name, ""))
               for spec in bench.frames.frames for each in spec.fields]
    assert sorted(signals) == sorted(SIGNALS)
    assert bench.frames.sync == SYNC
    assert {spec.roles: (spec.name, spec.sender, spec.is_before_sync) for spec in bench.frames.frames} == {
        ("command",): ("RPDO1", Role.RIG, True), ("feedback",): ("RPDO2", Role.PLANT, False),
        ("drive",): ("TPDO1", Role.CONTROLLER, False), ("valve_state",): ("plant TPDO2", Role.PLANT, False)}
    assert all(spec.every == 1 and spec.is_answer for spec in bench.frames.frames)
    assert {role: (node.node, node.eds, node.profile) for role, node in bench.nodes.items()} == {
        Role.CONTROLLER: (2, EDS[2], "cia408"), Role.PLANT: (3, EDS[3], "none")}
    assert bench.nodes[Role.CONTROLLER].settings[0] == (0x2110, 1, "controller.proportional_gain")
    assert list(bench.files) == ["eha.toml", "node2.eds", "node3.eds"]
    assert list_benches() == {"eha": "EHA controller"}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.parent.name)
def test_the_examples_load_and_their_logs_repeat_them(path: Path) -> None:
    bench = load_bench(str(path))
    again = load_bench_from_files(bench.files)
    assert repr(again.frames) == repr(bench.frames)
    assert (again.phases, again.ready, again.files) == (bench.phases, bench.ready, bench.files)


def test_a_drive_of_cia_402(tmp_path: Path) -> None:
    bench = load_bench(str(write_bench(tmp_path)))
    node = bench.nodes[Role.CONTROLLER]
    assert (node.node, node.eds, node.mode) == (5, tmp_path / "x.eds", 8)
    first, second, answer = bench.frames.frames
    values = {"position_demand": 0.001, "control_word": 0x0F, "ram_position": 0.002}
    assert pack(first, values) == bytes.fromhex("e8030000" "0f00")
    assert pack(second, values) == bytes.fromhex("00000040")  # 2.0 mm
    assert [spec.roles for spec in bench.frames.frames] == [("command",), ("feedback",), ("drive",)]
    assert (second.sender, answer.sender) == (Role.RIG, Role.CONTROLLER)
    assert answer.fields[0].count == Fraction(20, 1_000_000)


CAN_BENCH = """name = "an ECU"
cycle = "2 ms"
[controller]
protocol = "can"
dbc = "ecu.dbc"
timeout = "20 ms"
[controller.inputs]
position_demand = "Demand.Position"
ram_position = { signal = "Feedback.Position", count = "1 um", offset = "-1 mm" }
[controller.outputs]
current = "Drive.Current"
[controller.phases]
"Demand.Enable" = { main = "on", cleanup = 0 }
[controller.protection]
Demand.Counter = "counter"
"Demand.Crc" = { kind = "e2e_profile_1", data_id = 0x123 }
[controller.ready]
"Drive.State" = 3
"""
DBC = """VERSION ""
BU_: Rig Ecu
BO_ 256 Demand: 8 Rig
 SG_ Crc : 0|8@1+ (1,0) [0|0] "" Ecu
 SG_ Counter : 8|4@1+ (1,0) [0|15] "" Ecu
 SG_ Enable : 12|2@1+ (1,0) [0|3] "" Ecu
 SG_ Position : 31|24@0- (0.001,0) [0|0] "mm" Ecu
BO_ 257 Feedback: 4 Rig
 SG_ Position : 0|32@1- (1,0) [0|0] "" Ecu
BO_ 512 Drive: 12 Ecu
 SG_ Current : 0|32@1- (1,0) [0|0] "mA" Rig
 SG_ State : 32|8@1+ (1,0) [0|0] "" Rig
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 4;
SIG_VALTYPE_ 512 Current : 1;
VAL_ 256 Enable 1 "on" ;
"""


def test_an_ecu_on_plain_can(tmp_path: Path) -> None:
    bench = load_bench(str(write_bench(tmp_path, CAN_BENCH, ecu_dbc=DBC)))
    demand, feedback, drive = bench.frames.frames
    assert bench.phases == {"Demand.Enable": {"setup": 0, "main": 1, "cleanup": 0, "safe": 0}}
    assert (bench.ready, bench.timeout_ns, bench.nodes) == ({"Drive.State": 3}, 20_000_000, {})
    assert [spec.every for spec in bench.frames.frames] == [2, 2, 2]
    assert [(each.name, each.wrap) for each in demand.fields if each.protection is Protection.COUNTER] == [
        ("Demand.Counter", 15)]
    data = pack(demand, {"position_demand": 0.001, "Demand.Enable": 1.0}, counter=16)
    assert data[1:] == bytes.fromhex("11" "00" "0003e8" "0000")
    assert pack(feedback, {"ram_position": 0.0}) == (1000).to_bytes(4, "little")
    assert drive.fields[0].kind is Kind.FLOAT and drive.length == 12


def test_a_checksum_of_the_user_runs_where_he_trusts_it(tmp_path: Path) -> None:
    text = CAN_BENCH.replace('{ kind = "e2e_profile_1", data_id = 0x123 }', '"sum.py:add"')
    path = str(write_bench(tmp_path, text, ecu_dbc=DBC, sum_py="def add(data, counter):\n    return 7 + counter\n"))
    assert "--trust, because it brings code along that would run here: sum.py" in catch_refusal(load_bench, path)
    bench = load_bench(path, is_trusted=True)
    assert pack(bench.frames.frames[0], {}, counter=5)[0] == 12
    assert "sum.py" in load_bench_from_files(bench.files, is_trusted=True).files


def test_a_plant_node_shares_the_frames_of_the_controller(tmp_path: Path) -> None:
    objects = {"2000": Entry(3), "2001": Entry(8, "ro"), "2002": Entry(4, "ro")}
    plant = """[plant_node]
node = 6
eds = "p.eds"
[plant_node.inputs]
current = { object = "0x2000", count = "20 uA" }
[plant_node.outputs]
ram_position = { object = "0x2001", count = "1 mm" }
spool_position = { object = "0x2002", count = "1 nm" }
"""

    def load(words: tuple[int, ...] = (0x2001_0020,), drive: str = "0x185", text: str = plant) -> list[object]:
        sheet = format_eds(objects, [Mapped((0x2000_0010, 0x0006_0010), drive)],
                           [Mapped(words, "0x305", 2), Mapped((0x2002_0020,), "0x286")])
        bench = load_bench(str(write_bench(tmp_path, BENCH + text, p_eds=sheet)))
        return [(spec.name, spec.sender, spec.every, spec.roles) for spec in bench.frames.frames]

    assert load() == [("RPDO1", Role.RIG, 1, ("command",)), ("RPDO2", Role.PLANT, 2, ("feedback",)),
                      ("TPDO1", Role.CONTROLLER, 1, ("drive",)), ("plant TPDO2", Role.PLANT, 1, ("valve_state",))]
    for case, error in (({"drive": "0x1FF"}, "has none with the COB-ID of RPDO1, 0x1FF"),
                        ({"words": (0x2001_0020, 0x0005_0008)}, "the layout and counts of the controller's RPDO2"),
                        ({"text": plant.replace("1 mm", "1 um")}, "the layout and counts of the controller's RPDO2"),
                        ({"text": plant.replace("node = 6", "node = 5")}, "other than 5, which the controller has"),
                        ({"text": plant.replace("ram_position", "load_force").replace("1 mm", "1 N")},
                         "also the signal ram_position")):
        assert error in catch_refusal(load, **case)


MISTAKES = [
    ("name =", "nam =", "bench.toml:1: nam: expected a key: "),
    ('"a drive"', "3", "bench.toml:1: name: expected a text, not 3"),
    ("node = 5", "node = 128", "controller.node: expected a whole number from 1 to 127, not 128"),
    ("node = 5\n", "", "controller: expected also the key 'node', a node-ID from 1 to 127"),
    ("x.eds", "x\\u0000.eds", "controller.eds: expected the name of a file"),
    ("x.eds", "y.eds", "controller.eds: expected a file that can be read (No such file or directory): "),
    ('eds = "x.eds"\n', "", "controller.eds: expected the name of the device's EDS or DCF"),
    ("x.eds", "bench.toml", "bench.toml: expected an electronic data sheet (CiA 306)"),
    ("cia402", "cia403", "controller.profile: expected 'cia402', 'cia408' or 'none', not 'cia403'"),
    ("cia402", 'none"\nmode = 3#', 'controller.mode: expected profile = "cia402" with it'),
    ("[controller]", 'cycle = "1"\n[controller]', "cycle: expected a number and a unit, such as '1 s', not '1'"),
    ("[controller]", 'cycle = "1 h"\n[controller]', "cycle: expected whole microseconds from 0.1 to 100 ms, not '1 h'"),
    ("[controller]\n", '[controller]\ntimeout = "0.5 ms"\n', "controller.timeout: expected whole microseconds from 1"),
    ("[controller]", "bitrate = 5\n[controller]", "bitrate: expected a whole number from 10000 to 1000000 bit/s, not"),
    ("position_demand", "positon_demand", "inputs.positon_demand: expected a signal of the bench and its "),
    ('position_demand = { object = "0x2000", count = "1 um" }', "", "inputs: expected also the signal position_demand"),
    ('current = { object = "0x2002", count = "20 uA" }', "", "controller.outputs: expected also the signal current"),
    ("0x2000", "0x2222", "inputs.position_demand: expected an object of x.eds; it has no 0x2222"),
    ("0x2000", "2000h", "inputs.position_demand: expected an object such as 0x2110:1, not '2000h'"),
    ("0x2000", "0x2004:9", "expected an object of x.eds; it has no 0x2004:9; it has the sub-indices 0, 1"),
    ("0x2000", "0x2005", "expected a number; 0x2005 (Object 2005) has the data type 0x0009"),
    ("0x2000", "0x6041", "expected an object that can be written; 0x6041 (Object 6041) is ro"),
    ("0x2000", "0x2003", "an object that a RPDO maps; for 0x2003 with 8 bits RPDO1 and RPDO2 have room (map it in a"),
    ("0x2001", "0x2000", "ram_position: expected each value of the device once; 0x2000 is controller.inputs.position"),
    ("1 um", "1 bar", "inputs.position_demand.count: expected one of m, cm, mm, um, nm, inch, mil, not 'bar'"),
    ("1 um", "1", "inputs.position_demand.count: expected a number and a unit, such as '1 m', not '1'"),
    ("1 um", "0 um", "inputs.position_demand.count: expected a number other than 0"),
    (', count = "1 um"', "", "also what a count of 0x2000 is worth, such as count = '1 m'; its file gives it no unit"),
    ("count = \"1 um\"", "cuont = \"1 um\"", "position_demand.cuont: expected a key: 'count', 'object', 'offset' or"),
    ("[controller.outputs]", '[controller.phases]\n"0x2003" = 1\n[controller.outputs]',
     "controller.phases.0x2003: expected values by phase: 'cleanup', 'main', 'safe' or 'setup'"),
    ("[controller.outputs]", '[controller.parameters]\n"0x2003" = "controller.gain"\n[controller.outputs]',
     "controller.parameters.0x2003: expected a field of controller"),
    *(("[controller.outputs]", f'[controller.values]\n"{key}" = {value}\n[controller.outputs]',
       f"controller.values.{key}: expected {message}") for key, value, message in (
        ("0x2003", 300, "a number that Object 2003 can hold, not 300"), ("0x2003", 0.5, "a number that"),
        ("0x2006", 5, "a number that Object 2006 can hold, not 5"),
        ("0x2002", 1, "an object of the EDS that can be written"))),
    ("[controller.outputs]", 'mode = { object = "0x2003" }\n[controller.outputs]', "for 0x2003 with 8 bits RPDO1"),
    ("cia402", 'none"\ninputs.control_word.object = "0x2003#', "expected TOML; "),
]
SHEETS = [
    ((RPDOS[0]._replace(cob_id="0x80000205"), RPDOS[1]), TPDOS, "RPDO1 maps 0x2000, but is switched off (bit 31 of 0"),
    ((RPDOS[0]._replace(cob_id="0x305"), RPDOS[1]), TPDOS, "expected each identifier once; RPDO2 and RPDO1 have 0x305"),
    ((RPDOS[0]._replace(cob_id="0x80"), RPDOS[1]), TPDOS, "expected each identifier once; RPDO1 and SYNC have 0x080"),
    (RPDOS, (TPDOS[0]._replace(cob_id="0xBA"),), "each identifier once; TPDO1 and EMCY of node 5 have 0x0BA"),
    ((RPDOS[0]._replace(words=(*RPDOS[0].words, 0x2004_0110, 0x0005_0008)), RPDOS[1]), TPDOS,
     "x.eds: 0x1600: expected at most 8 bytes in RPDO1, not 72 bits"),
    ((RPDOS[0]._replace(kind=250), RPDOS[1]), TPDOS, "a transmission type 0 to 240, 254 or 255 for RPDO1, not 250"),
    ((RPDOS[0]._replace(words=(0x2000_0010, 0x6040_0010)), RPDOS[1]), TPDOS, "0x2000 with 32 bits in RPDO1, not 16"),
    ((RPDOS[0]._replace(words=(0x2999_0310, 0x6040_0010)), RPDOS[1]), TPDOS,
     "an object that a RPDO maps; RPDO1 maps 0x2999:3, which the file lacks; for 0x2000 with 32 bits RPDO1 and"),
    (RPDOS, (TPDOS[0]._replace(words=(0x2002_0010,)),),
     "controller.profile: expected an object that a TPDO maps; for 0x6041 with 16 bits TPDO1 has room"),
]
ENABLE = '[controller.phases]\n"Demand.Enable" = { main = "on", cleanup = 0 }\n[controller.protection]'
CAN_MISTAKES = [
    ("Demand.Position", "Demnd.Position", "MESSAGE.SIGNAL of ecu.dbc, not 'Demnd.Position'; did you mean Demand?"),
    ("Demand.Position", "Demand.Posit", "a signal of message Demand: 'Counter', 'Crc', 'Enable' or 'Position', not"),
    ("Demand.Position", "Drive.State", "each value of the device once; Drive.State is controller.inputs.position_dem"),
    ('"Drive.State" = 3', '"Demand.Crc" = 3', "each value of the device once; Demand.Crc is controller.ready"),
    ("Drive.Current", "Feedback.Position", "each value of the device once; Feedback.Position is controller.inputs.ra"),
    ('"Drive.State" = 3', '"Demand.Position" = 3', "each value of the device once; Demand.Position is controller.inp"),
    ('main = "on"', 'main = "off"', "controller.phases.Demand.Enable.main: expected a number or 'on', not 'off'"),
    ('main = "on"', "main = 4", "expected Demand.Enable from 0 to 3, not 4"),
    ('main = "on"', "main = 1.5", "a multiple of 1, the step of Demand.Enable, not 1.5"),
    ('main = "on"', "man = 1", "values by phase: 'cleanup', 'main', 'safe' or 'setup', not 'man'"),
    ('"counter"', '"crc9"', "counter, FILE.py:FUNCTION or a checksum: 'crc8_h2f', 'crc8_sae_j1850', "),
    ('"counter"', '"crc8_h2f"', "a byte for crc8_h2f; Demand.Counter has 4 bits from bit 8 on"),
    (ENABLE, '[controller.protection]\n"Demand.Enable" = "counter"', "one counter in a frame; Demand has Demand."),
    (", data_id = 0x123", "", "a data_id of 0 to 65535 with e2e_profile_1"),
    ('"ecu.dbc"', '"bench.toml"', "bench.toml: expected a DBC ("),
    ('dbc = "ecu.dbc"', "node = 3", "controller.node: expected protocol = \"canopen\" together with this key"),
    ('cycle = "2 ms"', 'cycle = "3 ms"', "a GenMsgCycleTime that is a multiple of the cycle, 3 ms, not 4 ms"),
    (', count = "1 um"', "", "what a count of Feedback.Position is worth, such as count = '1 m'; its file gives it n"),
    ("[controller.outputs]", '[plant_node]\nnode = 3\n[controller.outputs]', "plant_node: expected protocol = \"canop"),
    ('ram_position = {', 'control_word = "Demand.Enable"\nram_position = {', "each value of the device once"),
    ('[controller.phases]\n"Demand.Enable" = { main = "on", cleanup = 0 }', 'control_word = "Demand.Enable"',
     "expected a signal of the bench and its plant: 'current', 'cycle', 'mode_display' or 'status_word'"),
]


def read_mistake(path: Path) -> str:
    line = catch_refusal(load_bench, str(path))
    assert len(line) < 500
    return line


@pytest.mark.parametrize("old, new, error", MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_in_a_bench_file_is_one_line(old: str, new: str, error: str, tmp_path: Path) -> None:
    assert old in BENCH
    assert error in read_mistake(write_bench(tmp_path, BENCH.replace(old, new)))


@pytest.mark.parametrize("rpdos, tpdos, error", SHEETS, ids=range(len(SHEETS)))
def test_a_mistake_in_a_data_sheet_is_one_line(rpdos: list[Mapped], tpdos: list[Mapped], error: str,
                                               tmp_path: Path) -> None:
    path = write_bench(tmp_path)
    (tmp_path / "x.eds").write_text(format_eds(OBJECTS, rpdos, tpdos))
    assert error in read_mistake(path)


@pytest.mark.parametrize("old, new, error", CAN_MISTAKES, ids=range(len(CAN_MISTAKES)))
def test_a_mistake_with_a_dbc_is_one_line(old: str, new: str, error: str, tmp_path: Path) -> None:
    assert old in CAN_BENCH
    assert error in read_mistake(write_bench(tmp_path, CAN_BENCH.replace(old, new), ecu_dbc=DBC))


@pytest.mark.parametrize("old, new, error", [
    (": 8 Rig", ": 3 Rig", "a signal inside its frame; Demand.Position lies outside the 3 bytes of Demand"),
    (": 8 Rig", ": 10 Rig", "ecu.dbc: Demand: expected a length of a CAN frame, 0 to 8 bytes"),
    ("12|2@1+", "11|2@1+", "signals that do not overlap; Demand.Enable has bits of Demand.Counter"),
    ('"mm"', '"kg"', "what a count of Demand.Position is worth, such as count = '1 m'; its unit is 'kg'"),
    ("BO_ 257", "BO_ 256", "each identifier once; Feedback and Demand have 0x100"),
    ("(0.001,0)", "(0,0)", "counts that are worth something, from 1e-30 to 1e30"),
])
def test_a_mistake_in_a_dbc_is_one_line(old: str, new: str, error: str, tmp_path: Path) -> None:
    assert old in DBC
    assert error in read_mistake(write_bench(tmp_path, CAN_BENCH, ecu_dbc=DBC.replace(old, new)))


def test_more_frames_than_the_compiled_loops_tell_apart_are_one_line(tmp_path: Path) -> None:
    """A value beside the selector makes each page a frame."""
    pages = "".join(f' SG_ Value{n} m{n} : 32|8@1+ (1,0) [0|0] "" Rig\n' for n in range(60))
    dbc = ('VERSION ""\nNS_ :\nBS_:\nBU_: Rig Ecu\n\nBO_ 1 Demand: 8 Rig\n'
           ' SG_ Position : 0|32@1- (1,0) [0|0] "um" Ecu\n SG_ Ram : 32|32@1- (1,0) [0|0] "um" Ecu\n\n'
           'BO_ 2 Drive: 8 Ecu\n SG_ Page M : 0|8@1+ (1,0) [0|0] "" Rig\n SG_ Current : 8|16@1- (1,0) [0|0] "uA" Rig\n'
           f'{pages}')
    bench = ('name = "x"\n[controller]\nprotocol = "can"\ndbc = "ecu.dbc"\n[controller.inputs]\n'
             'position_demand = "Demand.Position"\nram_position = "Demand.Ram"\n[controller.outputs]\n'
             'current = "Drive.Current"\n[controller.ready]\n"Drive.Value0" = 1\n')
    assert "at most 48 frames or pages of multiplexed ones" in read_mistake(
        write_bench(tmp_path, bench, ecu_dbc=dbc))


@pytest.mark.parametrize("name, error", [
    ("nope", "nope: expected a .toml file, or 'eha', not 'nope'"), ("nope.toml", "nope.toml: expected a file that ca"),
])
def test_a_bench_that_does_not_exist_is_one_line(name: str, error: str) -> None:
    assert catch_refusal(load_bench, name).startswith(error)

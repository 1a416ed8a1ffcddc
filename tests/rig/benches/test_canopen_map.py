"""An EDS or DCF as frames: bits are those of canopen's own PDO maps, for any mapping."""

import io
import struct
from typing import Any

import canopen
import pytest
from canopen.objectdictionary.eds import import_eds
from device_files import BENCH as DRIVE, NODE, OBJECTS, RPDOS, TPDOS, Entry, Mapped, format_eds
from hypothesis import given, strategies as st

from rig.benches import EXTENDED, Role, load_bench_from_files, pack, read_dictionary, unpack
from rig.benches.bench import Kind, extract_bits
from rig.benches.canopen_map import list_values

# data type of CiA 301: bits
TYPES = {0x01: 1, 0x02: 8, 0x03: 16, 0x04: 32, 0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64, 0x05: 8, 0x06: 16,
         0x07: 32, 0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64, 0x08: 32, 0x11: 64}
INPUTS = {"position_demand": "1 mm", "ram_position": "1 um", "load_pressure": "1 bar", "load_force": "1 kN",
          "flags": "", "cycle": ""}
BENCH = """name = "x"
[controller]
node = 5
eds = "x.eds"
[controller.outputs]
current = {{ object = "0x2FFF", count = "1 mA" }}
[controller.inputs]
{}
"""


@st.composite
def draw_mappings(draw: st.DrawFn) -> list[list[tuple[int, int]]]:
    """RPDOs: data types, 1 with each that is a dummy, of at most 64 bits.

    BOOLEANs come last: numbers that do not begin with a byte canopen reads and writes wrongly.
    """
    pdos: list[list[tuple[int, int]]] = [[]]
    kinds = st.sampled_from(sorted(TYPES))
    for kind, is_dummy in draw(st.lists(st.tuples(kinds, st.sampled_from((0, 0, 0, 1))), min_size=2, max_size=6)):
        is_dummy = is_dummy if kind <= 7 else 0
        if sum(TYPES[each] for each, _ in pdos[-1]) + TYPES[kind] > 64:
            pdos.append([])
        pdos[-1].append((kind, is_dummy))
    return [sorted(pdo, key=lambda entry: entry[0] == 1) for pdo in pdos]


@given(pdos=draw_mappings().filter(lambda pdos: sum(not dummy for pdo in pdos for _, dummy in pdo) > 1),
       data=st.data())
def test_frames_are_those_of_canopen(pdos: list[list[tuple[int, int]]], data: st.DataObject) -> None:
    objects, rpdos, index = {"2FFF": Entry(4, "ro")}, [], 0x2000
    for number, pdo in enumerate(pdos):
        words = []
        for kind, is_dummy in pdo:
            words.append(kind << 16 | TYPES[kind] if is_dummy else index << 16 | TYPES[kind])
            if not is_dummy:
                objects[f"{index:04X}"] = Entry(kind)
                index += 1
        rpdos.append(Mapped(words, f"0x{0x205 + 0x10 * number:X}"))
    sheet = format_eds(objects, rpdos, [Mapped((0x2FFF_0020,), "0x181")])
    sheet = "[DummyUsage]\n" + "".join(f"Dummy{i:04}=1\n" for i in range(1, 8)) + "\n" + sheet
    inputs = list(INPUTS.items())[:index - 0x2000]
    lines = [f'{name} = {{ object = "0x{0x2000 + i:04X}"' + (f', count = "{count}"' if count else "") + " }"
             for i, (name, count) in enumerate(inputs)]
    bench = load_bench_from_files({"b.toml": BENCH.format("\n".join(lines)).encode(), "x.eds": sheet.encode()})
    remote = canopen.RemoteNode(NODE, import_eds(io.StringIO(sheet), NODE))  # type: ignore[no-untyped-call]
    remote.associate_network(canopen.Network())
    remote.rpdo.read(from_od=True)
    maps: Any = {each.cob_id: each for each in remote.rpdo.values()}
    for spec in bench.frames.list_from(Role.RIG):
        pdo_map = maps[spec.identifier]
        places = {name: i for i, (name, _) in enumerate(inputs, 0x2000)}
        fields = [each for each in spec.fields if each.name]
        for each in fields:
            numbers = st.integers(*each.range) if each.kind is not Kind.FLOAT else st.floats(width=32, allow_nan=False)
            pdo_map[places[each.name]].raw = data.draw(numbers)
        frame = bytes(pdo_map.data)
        assert len(frame) == spec.length
        for each in fields:
            raw = pdo_map[places[each.name]].raw
            if each.kind is not Kind.FLOAT:
                assert extract_bits(each, frame) == int(raw) & (1 << each.length) - 1
            assert unpack(spec, frame)[each.name] == pytest.approx(float(raw) * float(each.count), rel=1e-12)
        if all(each.length <= 48 and each.kind is not Kind.FLOAT for each in spec.fields):
            assert pack(spec, unpack(spec, frame)) == frame


def load(objects: dict[str, Entry], rpdos: tuple[Mapped, ...] = RPDOS, tpdos: tuple[Mapped, ...] = TPDOS) -> Any:
    return load_bench_from_files({"b.toml": DRIVE.encode(), "x.eds": format_eds(objects, rpdos, tpdos).encode()})


@pytest.mark.parametrize(("kind", "every", "is_answer"), [(0, 1, False), (1, 1, True), (240, 240, True), (254, 1, True),
                                                         (255, 1, True)])
def test_transmission_types_say_when_a_frame_comes(kind: int, every: int, is_answer: bool) -> None:
    assert [spec.is_before_sync for spec in load(OBJECTS).frames.frames] == [True, False, False]
    spec = load(OBJECTS, tpdos=(TPDOS[0]._replace(kind=kind),)).frames.frames[-1]
    assert (spec.every, spec.is_answer) == (every, is_answer)


def test_an_event_driven_frame_is_awaited_only_where_no_other_brings_the_current() -> None:
    tpdos = (TPDOS[0]._replace(kind=255), Mapped((0x2002_0010,), "0x285", 2))
    assert [spec.is_answer for spec in load(OBJECTS, tpdos=tpdos).frames.list_from(Role.CONTROLLER)] == [False, True]


def test_an_identifier_may_have_29_bits() -> None:
    rpdos = (RPDOS[0]._replace(cob_id="0x32345678"), RPDOS[1])
    assert load(OBJECTS, rpdos).frames.frames[0].identifier == 0x1234_5678 | EXTENDED


def test_what_the_bench_does_not_use_has_the_value_of_the_data_sheet() -> None:
    rpdos = (RPDOS[0], Mapped((0x2001_0020, 0x2003_0008, 0x0005_0008, 0x2004_0110), "0x305"))
    objects = {**OBJECTS, "2003": Entry(5, default="0x42"), "2004sub1": Entry(6, default="-2")}
    spec = load(objects, rpdos).frames.frames[1]
    assert pack(spec, {"ram_position": 0.0}) == bytes.fromhex("00000000" "42" "00" "feff")


def test_modes_are_signals_where_a_pdo_maps_them() -> None:
    objects = {**OBJECTS, "6060": Entry(2), "6061": Entry(2, "ro")}
    words = (*RPDOS[0].words, 0x6060_0008)
    bench = load(objects, (RPDOS[0]._replace(words=words), RPDOS[1]))
    assert bench.frames.frames[0].has("mode") and not bench.frames.frames[2].has("mode_display")
    assert bench.nodes[Role.CONTROLLER].mode == 8


def test_values_of_a_dcf_win_and_are_written_in_the_order_in_which_a_device_takes_them() -> None:
    rpdos = (RPDOS[0]._replace(value="$NODEID+0x400"), RPDOS[1])
    sheet = format_eds({**OBJECTS, "2003": Entry(5, value="7")}, rpdos, TPDOS)
    sheet += "[DeviceComissioning]\nNodeID=5\nBaudrate=1000\n"
    for section, value in (("1600sub0", "2"), ("1600sub1", "0x20000020")):
        sheet = sheet.replace(f"[{section}]\n", f"[{section}]\nParameterValue={value}\n")
    values = list_values(read_dictionary("x.dcf", sheet, NODE))
    assert [(index, sub, int.from_bytes(data, "little")) for index, sub, data in values] == [
        (0x2003, 0, 7), (0x1400, 1, 0x8000_0405), (0x1600, 0, 0), (0x1600, 1, 0x2000_0020), (0x1600, 0, 2),
        (0x1400, 1, 0x405)]
    bench = load_bench_from_files({"b.toml": DRIVE.encode(), "x.eds": sheet.encode()})
    assert bench.frames.frames[0].identifier == 0x405 and bench.nodes[Role.CONTROLLER].values == values


def test_a_pdo_whose_mapping_alone_a_dcf_gives_is_switched_off_as_well() -> None:
    sheet = format_eds({}, RPDOS).replace("[1600sub0]\n", "[1600sub0]\nParameterValue=1\n")
    values = list_values(read_dictionary("x.dcf", sheet, NODE))
    assert [(index, sub, int.from_bytes(data, "little")) for index, sub, data in values] == [
        (0x1400, 1, 0x8000_0205), (0x1600, 0, 1), (0x1400, 1, 0x205)]


def test_a_value_in_an_eds_is_not_written() -> None:
    sheet = format_eds({"2000": Entry(5, value="7")})
    assert list_values(read_dictionary("x.eds", sheet, NODE)) == ()
    assert len(list_values(read_dictionary("x.DCF", sheet, NODE))) == 1


def test_real_numbers_of_a_dcf_are_written_as_such() -> None:
    sheet = format_eds({"2000": Entry(8, value="1.5"), "2001": Entry(5, "ro", value="1")})
    assert list_values(read_dictionary("x.dcf", sheet, NODE)) == ((0x2000, 0, struct.pack("<f", 1.5)),)

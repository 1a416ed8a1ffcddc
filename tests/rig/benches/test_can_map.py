"""A DBC as frames: bits and numbers are those of cantools, for any layout; checksums are those of their standards."""

import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any, cast

import pytest
from cantools.autosar.end_to_end import compute_profile2_crc
from cantools.database import Database, load_string
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings, strategies as st
from refusals import catch_refusal

from plant import compile_function
from rig.benches import (
    ACCEPTED,
    EXTENDED,
    FD,
    FRAMES_AT,
    PAYLOAD,
    SWITCHED,
    VALUES_AT,
    FrameSpec,
    Role,
    find_frame,
    list_frame_places,
    list_loads,
    load_bench_from_files,
    make_layout,
    pack,
    pack_frame,
    unpack,
    unpack_frame,
)
from rig.benches.bench import Field, Kind, Protection, extract_bits
from rig.benches.checksums import compute_checksum, compute_crc8, load_checksum

INPUTS = {"position_demand": ("mm", 1e-3), "ram_position": ("m", 1.0), "load_pressure": ("bar", 1e5),
          "load_force": ("kN", 1e3), "spool_position": ("um", 1e-6), "flags": ("%", 1e-2)}
SCALES = (1, 0.1, 0.5, 0.001, 1e-5, 3, 20)


@st.composite
def draw_signals(draw: st.DrawFn, first: int, last: int, pages: tuple[int, ...] = ()) -> list[Signal]:
    """Signals named S0, S1 .. in the bytes from `first` on, Intel or Motorola, each in bytes of its own."""
    signals: list[Signal] = []
    while first < last and len(signals) < len(INPUTS):
        room = draw(st.integers(1, min(8, last - first)))
        is_float = room >= 4 and draw(st.booleans())
        length = (64 if room == 8 else 32) if is_float else draw(st.integers(1, 8 * room) | st.just(8 * room))
        shift = draw(st.integers(0, 8 * room - length))
        is_intel = draw(st.booleans())
        place = 8 * first + shift
        start = place if is_intel else 8 * (place // 8) + 7 - place % 8
        scale = draw(st.sampled_from(SCALES))
        conversion = BaseConversion.factory(scale=scale, offset=scale * draw(st.integers(-1000, 1000)),
                                            is_float=is_float)
        signals.append(Signal(f"S{len(signals)}", start, length, "little_endian" if is_intel else "big_endian",
                              is_signed=is_float or draw(st.booleans()), conversion=conversion,
                              multiplexer_ids=list(pages) or None, multiplexer_signal="Page" if pages else None))
        first += room
    return signals


@st.composite
def draw_message(draw: st.DrawFn) -> Message:
    """What the rig sends, with at least two signals; pages 3 and 9 where it is multiplexed."""
    length = draw(st.sampled_from((4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)))
    if draw(st.booleans()):
        signals = draw(draw_signals(0, length).filter(lambda signals: len(signals) > 1))
    else:
        page = Signal("Page", 0, 8, is_multiplexer=True)
        signals = draw(draw_signals(1, length, (3,)).filter(lambda signals: len(signals) > 1))
        other_signals = draw(draw_signals(1, length, (9,)))
        for signal in other_signals:
            signal.name = f"Other{signal.name}"
        signals = [page, *signals, *other_signals]
    for signal, (unit, _) in zip([each for each in signals if each.name[0] == "S"], INPUTS.values(), strict=False):
        signal.unit = unit
    is_long = draw(st.booleans())
    return Message(draw(st.integers(1, 0x1FFF_FFFF if is_long else 0x7FE)), "In", length, signals,
                   is_extended_frame=is_long, is_fd=length > 8, strict=True)


def load_frames(message: Message, *lines: str) -> tuple[FrameSpec, ...]:
    """The frames of a bench whose inputs are the signals S0, S1 .. of a message."""
    answer = Message(0x7FF, "Out", 2, [Signal("Current", 0, 16, unit="mA")])
    text = Database([message, answer]).as_dbc_string()
    count = sum(signal.name[0] == "S" for signal in message.signals)
    inputs = [f'{name} = "In.S{i}"' for i, name in enumerate(list(INPUTS)[:count])]
    bench = "\n".join(['name = "x"', "[controller]", 'protocol = "can"', 'dbc = "x.dbc"', "[controller.outputs]",
                       'current = "Out.Current"', "[controller.inputs]", *inputs, *lines])
    return load_bench_from_files({"x.toml": bench.encode(), "x.dbc": text.encode("cp1252")}).frames.frames


WRITE, READ = compile_function(pack_frame), compile_function(unpack_frame)


def pack_compiled(spec: FrameSpec, values: dict[str, float]) -> bytes:
    """The bytes by the compiled tables of the sender."""
    layout = make_layout([spec], list(values), Role.RIG)
    first = int(layout.words[VALUES_AT])
    layout.doubles[first: first + len(values)] = list(values.values())
    WRITE(layout, FRAMES_AT, 0)
    return layout.octets[8 * PAYLOAD: 8 * PAYLOAD + spec.length].tobytes()


def unpack_compiled(spec: FrameSpec, data: bytes) -> dict[str, float]:
    """The values that the compiled tables of the receiver read."""
    names = [each.name for each in spec.fields if each.name in INPUTS]
    layout = make_layout([spec], names, Role.CONTROLLER)
    layout.octets[8 * PAYLOAD: 8 * PAYLOAD + spec.length] = list(data)
    assert READ(layout, FRAMES_AT, spec.length, 0) == ACCEPTED
    return dict(zip(names, layout.doubles[int(layout.words[VALUES_AT]):].tolist(), strict=False))


@settings(max_examples=50)
@given(message=draw_message(), data=st.data())
def test_frames_are_those_of_cantools(message: Message, data: st.DataObject) -> None:
    spec = load_frames(message)[0]
    assert spec.identifier == (message.frame_id | (EXTENDED if message.is_extended_frame else 0)
                               | (FD if message.length > 8 else 0))
    names = dict(zip(INPUTS, [f"S{i}" for i in range(len(INPUTS))], strict=True))
    raw: dict[str, Any] = {"Page": 3} if message.is_multiplexed() else {}
    for each in (field for field in spec.fields if field.name in INPUTS):
        numbers = st.integers(*each.range) if each.kind is not Kind.FLOAT else st.floats(width=32, allow_nan=False,
                                                                                         allow_infinity=False)
        raw[names[each.name]] = data.draw(numbers)
    encoded = bytes(message.encode(raw, scaling=False, padding=False))
    for each in (field for field in spec.fields if field.name in INPUTS and field.kind is not Kind.FLOAT):
        assert extract_bits(each, encoded) == raw[names[each.name]] % (1 << each.length)
    reference: Any = message.decode(encoded, decode_choices=False)
    readings = unpack(spec, encoded)
    for name, signal in names.items():
        if name in readings:
            assert readings[name] == pytest.approx(
                reference[signal] * INPUTS[name][1], rel=1e-12, abs=1e-9 * INPUTS[name][1])
    anything = st.one_of(st.sampled_from((0.0, 1.0, -1.5, 1e-3, 1e25, -1e25)), st.floats(-1e3, 1e3))
    values = {name: data.draw(anything) for name in names if name in readings}
    packed = pack(spec, values)
    assert pack_compiled(spec, values) == packed
    assert all(unpack_compiled(spec, payload).items() <= unpack(spec, payload).items() for payload in (encoded, packed))
    exact = {each.name for each in spec.fields if each.length <= 48 and each.kind is not Kind.FLOAT}
    if all(each.name in exact or each.fixed is not None for each in spec.fields):
        assert pack(spec, readings) == encoded


def test_units_and_offsets_become_si_exactly() -> None:
    message = Message(1, "In", 8, [
        Signal("S0", 0, 16, unit="mm", conversion=BaseConversion.factory(scale=0.1, offset=5)),
        Signal("S1", 16, 16, unit="µm", conversion=BaseConversion.factory(scale=0.5, offset=0))])
    first, second = [each for each in load_frames(message)[0].fields if each.name]
    assert (first.count, first.offset, second.count) == (Fraction(1, 10_000), Fraction(1, 200), Fraction(1, 2_000_000))


@pytest.mark.parametrize("raw", [2**54 - 1, 2**63 + 2561, 2**64 - 513])
def test_a_number_of_more_than_53_bits_is_rounded_alike(raw: int) -> None:
    tenths = BaseConversion.factory(scale=0.1, offset=0)
    message = Message(1, "In", 12, [Signal("S0", 0, 64, unit="mm", conversion=tenths), Signal("S1", 64, 16, unit="m")],
                      is_fd=True)
    spec, data = load_frames(message)[0], raw.to_bytes(12, "little")
    assert unpack_compiled(spec, data).items() <= unpack(spec, data).items()


PAGES = """VERSION ""
BU_: Rig Ecu
BO_ 10 Demand: 8 Rig
 SG_ Position : 0|32@1- (0.001,0) [0|0] "mm" Ecu
 SG_ Ram : 32|16@1- (0.01,0) [0|0] "mm" Ecu
 SG_ Left : 48|8@1+ (1,0) [0|0] "" Ecu
 SG_ Overlap : 50|8@1+ (1,0) [0|0] "" Ecu
BO_ 11 Drive: 8 Ecu
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" Rig
 SG_ State : 8|8@1+ (1,0) [0|0] "" Rig
 SG_ Current m2 : 16|16@1- (0.02,0) [0|0] "mA" Rig
 SG_ Heat m3 : 16|16@1- (1,0) [0|0] "" Rig
BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 255;
BA_DEF_DEF_ "GenSigStartValue" 0;
BA_ "GenSigStartValue" SG_ 10 Left 7;
VAL_ 11 State 3 "run" ;
"""


def load_pages(*lines: str) -> Any:
    bench = "\n".join(['name = "x"', "[controller]", 'protocol = "can"', 'dbc = "x.dbc"', "[controller.inputs]",
                       'position_demand = "Demand.Position"', 'ram_position = "Demand.Ram"', "[controller.outputs]",
                       'current = "Drive.Current"', *lines])
    return load_bench_from_files({"x.toml": bench.encode(), "x.dbc": PAGES.encode()})


def list_pages(bench: Any) -> Iterator[tuple[str, bool, int | None]]:
    for spec in bench.frames.list_from(Role.CONTROLLER):
        yield spec.name, spec.is_answer, spec.selector.fixed if spec.selector else None


def test_a_page_is_a_frame_and_what_stands_on_all_pages_is_read_from_each() -> None:
    assert list(list_pages(load_pages())) == [("Drive[2]", True, 2)]
    bench = load_pages('[controller.ready]', '"Drive.State" = "run"')
    assert list(list_pages(bench)) == [("Drive[2]", True, 2), ("Drive[3]", False, 3)]
    assert [each.share for each in list_loads(bench)[1:]] == 2 * [list_loads(load_pages())[1].share / 2]
    frame = bytes([3, 3, 0, 0, 0, 0, 0, 0])
    assert bench.ready == {"Drive.State": 3} and unpack(bench.frames.find(11, frame), frame)["Drive.State"] == 3
    assert bench.frames.find(11, bytes([9]) + frame[1:]) is None


def test_a_signal_that_the_bench_file_does_not_use_has_its_start_value() -> None:
    spec = load_pages().frames.list_from(Role.RIG)[0]
    data = pack(spec, {"position_demand": 0.001, "ram_position": -1e-5})
    # of two that overlap the first is filled
    assert data == bytes.fromhex("e8030000ffff0700") and math.isclose(unpack(spec, data)["ram_position"], -1e-5)


MULTIPLEXED = """VERSION ""
BU_: Rig Ecu
BO_ 10 Demand: 16 Rig
 SG_ Kind M : 7|8@0+ (1,0) [0|0] "" Ecu
 SG_ Position m2 : 16|16@1- (0.001,0.5) [0|0] "mm" Ecu
 SG_ Ram m4 : 16|16@1- (0.01,0) [0|0] "mm" Ecu
BO_ 11 Drive: 8 Ecu
 SG_ Kind M : 0|8@1+ (1,0) [0|0] "" Rig
 SG_ Current m5 : 31|16@0- (0.02,0) [0|0] "mA" Rig
 SG_ State m3 : 16|8@1+ (1,0) [0|0] "" Rig
 SG_ Heat m1 : 16|16@1- (1,0) [0|0] "" Rig
BA_DEF_ BO_ "CANFD_BRS" ENUM "0","1";
BA_DEF_DEF_ "CANFD_BRS" "1";
SG_MUL_VAL_ 10 Position Kind 2-3;
SG_MUL_VAL_ 10 Ram Kind 4-4;
SG_MUL_VAL_ 11 Current Kind 5-5;
SG_MUL_VAL_ 11 State Kind 3-3;
SG_MUL_VAL_ 11 Heat Kind 1-1;
"""


def load_multiplexed(dbc: str, state: str) -> Any:
    text = "\n".join(['name = "x"', "[controller]", 'protocol = "can"', 'dbc = "x.dbc"', "[controller.inputs]",
                      'position_demand = "Demand.Position"', 'ram_position = "Demand.Ram"', "[controller.outputs]",
                      'current = "Drive.Current"', "[controller.ready]", f'"Drive.{state}" = 3'])
    return load_bench_from_files({"x.toml": text.encode(), "x.dbc": dbc.encode()})


@pytest.mark.parametrize("state, pages", [
    ("State", ["Demand[2]", "Demand[3]", "Demand[4]", "Drive[3]", "Drive[5]"]),
    ("Heat", ["Demand[2]", "Demand[3]", "Demand[4]", "Drive[1]", "Drive[5]"])])
def test_pages_of_a_multiplexer_are_those_of_cantools(state: str, pages: list[str]) -> None:
    """Each page is known by its selector, also in the compiled tables; CANFD_BRS counts for CAN FD."""
    frames = load_multiplexed(MULTIPLEXED, state).frames
    database = cast(Database, load_string(MULTIPLEXED, "dbc"))
    assert sorted(spec.name for spec in frames.frames) == pages
    layout = make_layout(frames.frames, [], Role.RIG)
    for place, spec in zip(list_frame_places(layout), frames.frames, strict=True):
        message = database.get_message_by_name(spec.name.partition("[")[0])
        data = pack(spec, {"position_demand": 1e-3, "ram_position": -2e-4, "current": 4e-3})
        reference: Any = message.decode(data)
        assert spec.name == f"{message.name}[{reference['Kind']}]" and bytes(message.encode(reference)) == data
        for name, signal in (("Position", "position_demand"), ("Ram", "ram_position"), ("Current", "current")):
            if name in reference:
                assert unpack(spec, data)[signal] == pytest.approx(1e-3 * reference[name])
        layout.octets[8 * PAYLOAD: 8 * PAYLOAD + len(data)] = list(data)
        assert frames.find(spec.identifier, data) is spec and find_frame(layout, spec.identifier) == place
        assert spec.sent_as == message.frame_id | (FD | SWITCHED if message.length > 8 else 0)


def test_nested_multiplexers_are_refused() -> None:
    part = "SG_ Part m3M : 40|8@1+ (1,0) [0|0] \"\" Rig"
    nested = MULTIPLEXED.replace("SG_ State m3 :", f"{part}\n SG_ State m3 :").replace(
        "SG_MUL_VAL_ 11 State Kind 3-3;", "SG_MUL_VAL_ 11 Part Kind 3-3;\nSG_MUL_VAL_ 11 State Part 3-3;")
    message = catch_refusal(load_multiplexed, nested, "State")
    assert "signals of one multiplexer; Drive has Kind and Part, a nested one" in message


def test_a_selector_has_no_other_use() -> None:
    assert "Drive.Page is the multiplexer of used ones" in catch_refusal(
        load_pages, "[controller.ready]", '"Drive.Page" = 2')


# AUTOSAR SWS CRC Library, 7.2.1.2 and 7.2.1.3: data, CRC-8 (SAE J1850), CRC-8 with polynomial 0x2F
PUBLISHED = """00000000 59 12; F20183 37 C2; 0FAA0055 79 C6; 00FF5511 B8 77; 332255AABBCCDDEEFF CB 11; 926B55 8C 33;
FFFFFFFF 74 6C"""


def make_field(checksum: str, **options: object) -> Field:
    return Field(name="", lowest=0, length=8, protection=Protection.CHECKSUM, checksum=checksum, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "polynomial", "column"), [("crc8_sae_j1850", 0x1D, 1), ("crc8_h2f", 0x2F, 2)])
@pytest.mark.parametrize("row", PUBLISHED.split(";"))
def test_crcs_equal_the_tables_of_autosar(row: str, name: str, polynomial: int, column: int) -> None:
    words = [bytes.fromhex(word) for word in row.split()]
    assert compute_crc8(words[0], polynomial) == words[column][0] == compute_checksum(
        make_field(name), b"\xA5" + words[0], 0)


@pytest.mark.parametrize("data_id, data, checksum", [
    # AUTOSAR PRS E2E, profile 1, data ID mode "both": eight bytes of which one is the CRC and one holds the counter
    (0x123, "0000000000000000", 0xCC), (0x123, "0001000000000000", 0x91),
])
def test_profile_1_equals_the_example_of_autosar(data_id: int, data: str, checksum: int) -> None:
    assert compute_checksum(make_field("e2e_profile_1", data_id=data_id), bytes.fromhex(data), 0) == checksum


@given(data=st.binary(min_size=2, max_size=64), ids=st.lists(st.integers(0, 255), min_size=16, max_size=16))
def test_profile_2_equals_that_of_cantools(data: bytes, ids: list[int]) -> None:
    counter = data[1] & 0xF
    assert compute_profile2_crc(data, ids[counter]) == compute_checksum(
        make_field("e2e_profile_2", data_ids=tuple(ids)), data, counter)


@given(data=st.binary(min_size=1, max_size=8), crc=st.integers(0, 255))
def test_what_stands_in_the_field_does_not_count(data: bytes, crc: int) -> None:
    user_checksum = load_checksum("sums.py", b"def add(data, counter):\n    return sum(data) + counter\n", "add")
    for name in ("crc8_sae_j1850", "crc8_h2f", "e2e_profile_1", user_checksum):
        each = make_field(name)
        assert compute_checksum(each, bytes([crc]) + data[1:], 3) == compute_checksum(each, data, 3)
    assert compute_checksum(make_field(user_checksum), data, 3) == (sum(data[1:]) + 3) & 0xFF


@pytest.mark.parametrize("source, error", [
    ("def f(:", "sums.py:1: expected Python ("),
    ("g = 1", "sums.py: f: expected a function (data: bytes, counter: int) -> int"),
    ("def f(data, counter): return 'x'", "sums.py: f: expected a whole number from (data, counter), not ValueError"),
    ("def f(data): return 1", "sums.py: f: expected a whole number from (data, counter), not TypeError"),
])
def test_an_error_of_a_user_is_one_line(source: str, error: str) -> None:
    assert catch_refusal(load_checksum, "sums.py", source.encode(), "f").startswith(error)

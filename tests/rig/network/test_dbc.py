"""DBC, object dictionaries and code say the same thing, signal by signal."""

import random
import struct
import tomllib
from collections.abc import Callable, Iterator
from importlib.resources import files
from typing import NamedTuple, cast

import canopen
import cantools
import codec
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from cantools.database.can import Database
from codec import SIGNALS, Signal

from dbc import DBC, EDS
from rig.conformance.run_cases import choose_cases, run_cases
from rig.conformance.target import DataSheet, Target, Verdict
from rig.network.bus import EmbeddedWire
from rig.network.frame import VirtualClock

FRAMES = (codec.COMMAND, codec.FEEDBACK, codec.VALVE_STATE, codec.DRIVE)
NODES = {1: "Rig", 2: "Controller", 3: "Plant"}
SENDERS = {codec.COMMAND: 1, codec.FEEDBACK: 3, codec.VALVE_STATE: 3, codec.DRIVE: 2}
RECEIVERS = {codec.COMMAND: {2}, codec.FEEDBACK: {1, 2}, codec.VALVE_STATE: {1}, codec.DRIVE: {1, 3}}
WIDTHS = {datatypes.INTEGER32: (32, True), datatypes.UNSIGNED16: (16, False)}
class Pdo(NamedTuple):
    """One PDO of one dictionary."""

    node: int
    cob_id: int
    sends: bool
    kind: int
    objects: list[tuple[ODVariable, int]]  # mapped object, length in bits


def load_database() -> Database:
    return cast(Database, cantools.database.load_file(DBC))


def pdos(node: int) -> Iterator[Pdo]:
    """Every PDO of a node's EDS, as canopen reads it."""
    od = canopen.import_od(str(EDS[node]), node)
    for base in (0x1400, 0x1800):
        for index in (index for index in od if base <= index < base + 0x200):
            words = [od[index + 0x200][sub].default for sub in range(1, od[index + 0x200][0].default + 1)]
            objects = [(variable(od, word >> 16, word >> 8 & 0xFF), word & 0xFF) for word in words]
            yield Pdo(node, od[index][1].default, base == 0x1800, od[index][2].default, objects)


def variable(od: canopen.ObjectDictionary, index: int, sub: int) -> ODVariable:
    item = od[index]
    return item if isinstance(item, ODVariable) else item[sub]


ALL_PDOS = [pdo for node in EDS for pdo in pdos(node)]


def signals(cob_id: int) -> list[Signal]:
    return [signal for signal in SIGNALS if signal.cob_id == cob_id]


@pytest.mark.parametrize("cob_id", FRAMES, ids=hex)
def test_dbc_and_code_agree(cob_id: int) -> None:
    """Signal by signal; the limits are those of the raw type."""
    message = load_database().get_message_by_frame_id(cob_id)
    assert message.length == 8 and not message.is_extended_frame
    assert message.senders == [NODES[SENDERS[cob_id]]]
    assert signals(cob_id) == [
        Signal(cob_id, s.name, s.start, s.length, s.is_signed, s.scale, s.unit or "") for s in message.signals]
    for s in message.signals:
        assert s.byte_order == "little_endian" and s.offset == 0
        assert set(s.receivers) == {NODES[node] for node in RECEIVERS[cob_id]}
        low, high = (-(2**31), 2**31 - 1) if s.is_signed else (0, 2**16 - 1)
        assert (s.minimum, s.maximum) == pytest.approx((low * s.scale, high * s.scale), rel=1e-12)


@pytest.mark.parametrize("pdo", ALL_PDOS, ids=lambda pdo: f"node{pdo.node}-{'T' if pdo.sends else 'R'}{pdo.cob_id:03X}")
def test_dictionaries_and_code_agree(pdo: Pdo) -> None:
    """Mapping order, length, sign, scale and unit of every mapped object."""
    start, found = 0, []
    for signal, (mapped, bits) in zip(signals(pdo.cob_id), pdo.objects, strict=True):
        length, signed = WIDTHS[mapped.data_type]
        assert bits == length
        assert mapped.pdo_mappable
        found.append(Signal(pdo.cob_id, signal.name, start, bits, signed, mapped.factor, mapped.unit))
        start += bits
    assert found == signals(pdo.cob_id)
    assert start == 64


def test_each_frame_has_its_sender_and_receivers_and_the_transmission_types_of_the_interface() -> None:
    assert {pdo.cob_id: pdo.node for pdo in ALL_PDOS if pdo.sends} == SENDERS
    heard = {cob_id: {pdo.node for pdo in ALL_PDOS if not pdo.sends and pdo.cob_id == cob_id} for cob_id in FRAMES}
    assert heard == RECEIVERS
    kinds = {(pdo.node, pdo.cob_id): pdo.kind for pdo in ALL_PDOS if pdo.node != 1}
    assert kinds == {(2, 0x202): 1, (2, 0x183): 255, (2, 0x182): 255, (3, 0x182): 1, (3, 0x183): 1, (3, 0x283): 1}


def test_cantools_and_codec_make_the_same_bytes() -> None:
    """Random raw values through an independent encoder and back through ours."""
    database, rng = load_database(), random.Random(1)
    packs: dict[int, Callable[..., bytes]] = {
        codec.COMMAND: codec.pack_command, codec.FEEDBACK: codec.pack_feedback,
        codec.VALVE_STATE: codec.pack_valve_state, codec.DRIVE: codec.pack_drive,
    }  # fmt: skip
    for cob_id, pack in packs.items():
        message = database.get_message_by_frame_id(cob_id)
        for _ in range(200):
            low_high = {s.name: (-(2**31), 2**31) if s.signed else (0, 2**16) for s in signals(cob_id)}
            raw = {name: rng.randrange(*span) for name, span in low_high.items()}
            data = message.encode(raw, scaling=False)
            values = message.decode(data)
            assert pack(*values.values()) == data
            assert struct.unpack("<ii" if cob_id == codec.FEEDBACK else "<iHH", data) == tuple(raw.values())


def test_dbc_names_the_services_of_all_nodes() -> None:
    """COB-IDs of the predefined connection set; EMCY as in 0x1014, SDO as in 0x1200."""
    ids = {message.frame_id: message.name for message in load_database().messages}
    assert ids.pop(codec.SYNC) == "SYNC"
    assert ids.pop(0x000) == "NMT"
    for node in EDS:
        od = canopen.import_od(str(EDS[node]), node)
        assert ids.pop(od[0x1014].default) == f"EMCY_{node}"
        assert ids.pop(0x700 + node) == f"heartbeat_{node}"
        if 0x1200 in od:
            assert ids.pop(od[0x1200][1].default) == f"SDO_request_{node}"
            assert ids.pop(od[0x1200][2].default) == f"SDO_answer_{node}"
    assert set(ids) == set(FRAMES)


def test_gains_in_the_dictionary_are_the_nominal_ones() -> None:
    nominal = tomllib.loads(files("plant").joinpath("models", "nominal.toml").read_text())["controller"]
    od = canopen.import_od(str(EDS[2]), 2)
    names = ("proportional_gain", "integral_gain", "derivative_gain", "current_limit", "period")
    assert [od[0x2110][sub].default for sub in range(1, 6)] == [nominal[name] for name in names]


@pytest.mark.parametrize("node", EDS)
def test_eds_is_well_formed_and_only_the_rig_makes_sync(node: int) -> None:
    """By chapter 1 of the conformance test: lists, counts, types, PDOs, identity and COB-IDs."""
    sheet = DataSheet(EDS[node], node)
    outcome = run_cases(Target(EmbeddedWire(VirtualClock(), []), sheet), choose_cases(["1"]))
    assert [(each.case.number, each.measured) for each in outcome.results if each.verdict is Verdict.FAIL] == []
    assert sheet.default(0x1005) == codec.SYNC | (node == 1) << 30
    assert sheet.text.get("FileInfo", "FileName") == EDS[node].name

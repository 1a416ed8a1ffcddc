"""DBC, object dictionaries and code say the same thing, signal by signal."""

import tomllib
from collections.abc import Iterator
from importlib.resources import files
from typing import NamedTuple, cast

import canopen
import cantools
import codec
import pytest
from cantools.database.can import Database
from codec import SIGNALS, Signal

from dbc import DBC, EDS

FRAMES = (codec.COMMAND, codec.FEEDBACK, codec.VALVE_STATE, codec.DRIVE)
NODES = {1: "Rig", 2: "Controller", 3: "Plant"}
SENDERS = {codec.COMMAND: 1, codec.FEEDBACK: 3, codec.VALVE_STATE: 3, codec.DRIVE: 2}
RECEIVERS = {codec.COMMAND: {2}, codec.FEEDBACK: {1, 2}, codec.VALVE_STATE: {1}, codec.DRIVE: {1, 3}}


class Pdo(NamedTuple):
    """One PDO of one dictionary."""

    node: int
    cob_id: int
    sends: bool
    kind: int


def load_database() -> Database:
    return cast(Database, cantools.database.load_file(DBC))


def pdos(node: int) -> Iterator[Pdo]:
    """Every PDO of a node's EDS, as canopen reads it."""
    od = canopen.import_od(str(EDS[node]), node)
    for base in (0x1400, 0x1800):
        for index in (index for index in od if base <= index < base + 0x200):
            yield Pdo(node, od[index][1].default, base == 0x1800, od[index][2].default)


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


def test_each_frame_has_its_sender_and_receivers_and_the_transmission_types_of_the_interface() -> None:
    assert {pdo.cob_id: pdo.node for pdo in ALL_PDOS if pdo.sends} == SENDERS
    receivers = {cob_id: {pdo.node for pdo in ALL_PDOS if not pdo.sends and pdo.cob_id == cob_id} for cob_id in FRAMES}
    assert receivers == RECEIVERS
    kinds = {(pdo.node, pdo.cob_id): pdo.kind for pdo in ALL_PDOS if pdo.node != 1}
    assert kinds == {(2, 0x202): 1, (2, 0x183): 255, (2, 0x182): 255, (3, 0x182): 1, (3, 0x183): 1, (3, 0x283): 1}


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

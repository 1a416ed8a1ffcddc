"""Codec: every value survives, the edges saturate, and what has no raw value is refused."""
from __future__ import annotations

import math
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.network import codec

INT32 = st.integers(-(2**31), 2**31 - 1)
WORD = st.integers(0, 0xFFFF)
QUANTITIES = {
    "position": (codec.raw_position, codec.position, codec.POSITION),
    "pressure": (codec.raw_pressure, codec.pressure, codec.PRESSURE),
    "spool": (codec.raw_spool, codec.spool, codec.SPOOL),
    "current": (codec.raw_current, codec.current, codec.CURRENT),
}
Quantity = tuple[Callable[[float], int], Callable[[int], float], float]
quantities = pytest.mark.parametrize("quantity", QUANTITIES.values(), ids=QUANTITIES)


@quantities
@given(raw=INT32)
def test_every_raw_value_survives_decoding_and_encoding(quantity: Quantity, raw: int) -> None:
    encode, decode, _ = quantity
    assert encode(decode(raw)) == raw


@quantities
@given(counts=st.floats(-2e9, 2e9))
def test_encoding_is_off_by_half_a_count_at_most(quantity: Quantity, counts: float) -> None:
    encode, decode, resolution = quantity
    value = counts * resolution
    assert abs(decode(encode(value)) - value) <= 0.5 * resolution * (1 + 1e-6)


@quantities
def test_out_of_range_saturates_and_nan_is_refused(quantity: Quantity) -> None:
    encode, _, resolution = quantity
    for value in (2**31 * resolution, 1e300, math.inf):
        assert encode(value) == 2**31 - 1
        assert encode(-1.001 * value) == -(2**31)
    with pytest.raises(ValueError, match="NaN"):
        encode(math.nan)


def test_a_raw_value_decodes_to_the_double_nearest_to_its_decimal() -> None:
    assert codec.position(50_000) == 0.005
    assert codec.current(800_000) == 0.008
    assert codec.spool(3) == 3e-9
    assert codec.pressure(2_100_000) == 21e6


@given(raw=INT32, load=INT32, word=WORD, cycle=WORD)
def test_frames_survive(raw: int, load: int, word: int, cycle: int) -> None:
    for pack, unpack, values in (
            (codec.pack_command, codec.unpack_command, codec.Command(codec.position(raw), word, cycle)),
            (codec.pack_feedback, codec.unpack_feedback, codec.Feedback(codec.position(raw), codec.pressure(load))),
            (codec.pack_valve_state, codec.unpack_valve_state, codec.ValveState(codec.spool(raw), word, cycle)),
            (codec.pack_drive, codec.unpack_drive, codec.Drive(codec.current(raw), word, cycle))):
        data = pack(*values)  # type: ignore[arg-type]
        assert unpack(data) == values
        for other in (data[:0], data[:7], data + b"1"):
            with pytest.raises(struct.error):
                unpack(other)


def test_the_bytes_are_those_of_the_interface() -> None:
    """Little endian, written out by hand."""
    assert codec.pack_command(0.005, 0x0007, 0x1234).hex() == "50c300000700" + "3412"
    assert codec.pack_feedback(-1e-7, 20.0).hex() == "ffffffff" + "02000000"
    assert codec.pack_valve_state(1e-9, 0x8001, 1).hex() == "01000000" + "0180" + "0100"
    assert codec.pack_drive(-0.008, 0x000F, 65536).hex() == "00cbf3ff" + "0f00" + "0000"  # the cycle wraps

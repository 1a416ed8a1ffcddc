"""The emulator's record of its cycles survives the way through object 0x2212."""

import contextlib
import zlib

import numpy as np
import pytest
from hypothesis import given, strategies as st

from plant.errors import InputError
from rig.network.node_objects import CycleRecord, decode_cycle_record, encode_cycle_record


def make_record(cycles: int, seed: int = 0) -> CycleRecord:
    """Cycles of 1 ms with the scatter of a machine at work, a pause, and one stall."""
    rng = np.random.default_rng(seed)
    k = np.arange(cycles) + 1000 * (np.arange(cycles) > cycles // 2)
    sync = 5_000_000_000_000 + k * 1_000_000 + rng.exponential(8e3, cycles).astype(np.int64)
    start = sync + 20_000 + rng.exponential(5e3, cycles).astype(np.int64)
    if cycles > 10:
        start[10] += 50_000_000
    sent = start + 15_000 + rng.exponential(2e3, cycles).astype(np.int64)
    done = sent + 7_000 + rng.exponential(1e3, cycles).astype(np.int64)
    return CycleRecord(k, sync, start, sent, done, rng.integers(0, 8, cycles))


@pytest.mark.parametrize("cycles", [0, 1, 2, 13_500])
def test_survives_to_the_microsecond(cycles: int) -> None:
    record = make_record(cycles)
    back = decode_cycle_record(encode_cycle_record(record))
    assert np.array_equal(back.cycle, record.cycle) and np.array_equal(back.flags, record.flags)
    for name in ("sync", "start", "sent", "done"):
        assert np.all(np.abs(getattr(back, name) - getattr(record, name)) < 2000), name


def test_is_small_enough_for_sdo() -> None:
    """An SDO segment carries 7 bytes: a run of 13.5 s must not take as long to report."""
    assert len(encode_cycle_record(make_record(13_500))) < 7 * 13_500


@pytest.mark.parametrize("bad", [b"x", b"ECR1", b"ECR2" + bytes(12), b"ECR1" + b"\5\0\0\0" + bytes(8) + b"junk",
                                 b"ECR1" + b"\5\0\0\0" + bytes(8) + zlib.compress(b"short"),
                                 b"ECR1" + b"\xff\xff\xff\xff" + bytes(8) + zlib.compress(bytes(24))])
def test_other_bytes_are_refused(bad: bytes) -> None:
    with pytest.raises(InputError, match="0x2212"):
        decode_cycle_record(bad)


@given(st.binary(max_size=60))
def test_any_bytes_give_a_record_or_an_input_error(data: bytes) -> None:
    with contextlib.suppress(InputError):
        assert len(decode_cycle_record(data).cycle) >= 0

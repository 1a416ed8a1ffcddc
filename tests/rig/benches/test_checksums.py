"""Checksums: the tables of the standards, other people's code, and functions of users."""

import pytest
from cantools.autosar.end_to_end import compute_profile2_crc
from hypothesis import given
from hypothesis import strategies as st

from plant.errors import InputError
from rig.benches.bench import Field, Guard
from rig.benches.checksums import compute_checksum, compute_crc8, load_checksum

# AUTOSAR SWS CRC Library, 7.2.1.2 and 7.2.1.3: data, CRC-8 (SAE J1850), CRC-8 with polynomial 0x2F
PUBLISHED = """00000000 59 12; F20183 37 C2; 0FAA0055 79 C6; 00FF5511 B8 77; 332255AABBCCDDEEFF CB 11; 926B55 8C 33;
FFFFFFFF 74 6C"""


def make_field(checksum: str, **options: object) -> Field:
    return Field(name="", lowest=0, length=8, guard=Guard.CHECKSUM, checksum=checksum, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("row", PUBLISHED.split(";"))
def test_crcs_equal_the_tables_of_autosar(row: str) -> None:
    data, j1850, h2f = (bytes.fromhex(word) for word in row.split())
    assert compute_crc8(data, 0x1D) == j1850[0]
    assert compute_crc8(data, 0x2F) == h2f[0]
    for name, expected in (("crc8_sae_j1850", j1850), ("crc8_h2f", h2f)):
        assert compute_checksum(make_field(name), b"\xA5" + data, 0) == expected[0]


@pytest.mark.parametrize("data_id, data, expected", [
    # AUTOSAR PRS E2E, profile 1, data ID mode "both": eight bytes of which one is the CRC and one holds the counter
    (0x123, "0000000000000000", 0xCC), (0x123, "0001000000000000", 0x91),
])
def test_profile_1_equals_the_example_of_autosar(data_id: int, data: str, expected: int) -> None:
    assert compute_checksum(make_field("e2e_profile_1", data_id=data_id), bytes.fromhex(data), 0) == expected


@given(data=st.binary(min_size=2, max_size=64), ids=st.lists(st.integers(0, 255), min_size=16, max_size=16))
def test_profile_2_equals_that_of_cantools(data: bytes, ids: list[int]) -> None:
    counter = data[1] & 0xF
    own = compute_checksum(make_field("e2e_profile_2", data_ids=tuple(ids)), data, counter)
    assert own == compute_profile2_crc(data, ids[counter])


@given(data=st.binary(min_size=1, max_size=8), crc=st.integers(0, 255))
def test_what_stands_in_the_field_does_not_count(data: bytes, crc: int) -> None:
    known = load_checksum("sums.py", b"def add(data, counter):\n    return sum(data) + counter\n", "add")
    for name in ("crc8_sae_j1850", "crc8_h2f", "e2e_profile_1", known):
        each = make_field(name)
        assert compute_checksum(each, bytes([crc]) + data[1:], 3) == compute_checksum(each, data, 3)
    assert compute_checksum(make_field(known), data, 3) == (sum(data[1:]) + 3) & 0xFF


@pytest.mark.parametrize("source, error", [
    ("def f(:", "sums.py:1: expected Python ("),
    ("g = 1", "sums.py: f: expected a function (data: bytes, counter: int) -> int"),
    ("def f(data, counter): return 'x'", "sums.py: f: expected a whole number from (data, counter), not ValueError"),
    ("def f(data): return 1", "sums.py: f: expected a whole number from (data, counter), not TypeError"),
])
def test_an_error_of_a_user_is_one_line(source: str, error: str) -> None:
    with pytest.raises(InputError) as raised:
        load_checksum("sums.py", source.encode(), "f")
    assert str(raised.value).startswith(error) and "\n" not in str(raised.value)

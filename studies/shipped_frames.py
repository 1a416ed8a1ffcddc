"""The frames of the shipped bench: identifiers by role, and values into and out of payloads."""

from collections.abc import Mapping

from rig.benches import load_bench, pack, unpack

_FRAMES = load_bench().frames
_SPECS = {spec.identifier: spec for spec in _FRAMES.frames}
SYNC = _FRAMES.sync or 0
COMMAND, FEEDBACK, VALVE_STATE, DRIVE = (
    _FRAMES.find_role(role).identifier for role in ("command", "feedback", "valve_state", "drive"))


def pack_frame(identifier: int, values: Mapping[str, float]) -> bytes:
    """The payload of a frame; a value that is not given is 0."""
    return pack(_SPECS[identifier], values)


def unpack_frame(identifier: int, data: bytes) -> dict[str, float]:
    """The values of a frame, SI.

    Raises:
        ValueError: a payload of another length.
    """
    return unpack(_SPECS[identifier], data)

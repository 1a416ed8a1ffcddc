"""A CAN log decoded by any DBC: each signal is a channel with the times of its frames."""
from __future__ import annotations

from array import array
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fdi.trace.importing.measurement import Channel
from plant.errors import InputError
from rig.recorder.convert import list_can_messages


@dataclass(frozen=True)
class CanMeasurement:
    """A CAN log and the messages of its DBC; channels are named by message and signal, with a dot."""

    path: Path
    format: str
    units: Mapping[str, str]
    messages: Mapping[tuple[int, bool], Any]  # (identifier, is extended) to the message of the DBC
    has_times: bool = True

    def read(self, names: Collection[str], dates: Collection[str] = ()) -> dict[str, Channel]:
        """The signals and their times since the first frame of the log. Frames that are too short are left out.

        Raises:
            InputError: a log that cannot be read, or without a frame of one of the signals.
        """
        wanted: dict[str, list[str]] = {}
        for name in names:
            message, _, signal = name.rpartition(".")
            wanted.setdefault(message, []).append(signal)
        values = {name: array("d") for name in names}
        times = {name: array("d") for name in names}
        first: float | None = None
        for frame in list_can_messages(self.path):
            first = frame.timestamp if first is None else first
            known = self.messages.get((frame.arbitration_id, frame.is_extended_id))
            if known is None or known.name not in wanted or len(frame.data) < known.length:
                continue
            found = known.decode(bytes(frame.data), decode_choices=False)
            for signal in wanted[known.name]:
                if signal in found:  # of a multiplexed message, those of this frame
                    name = f"{known.name}.{signal}"
                    values[name].append(float(found[signal]))
                    times[name].append(frame.timestamp - first)
        for name, column in values.items():
            if not column:
                raise InputError(self.path, name, "at least one frame of this message")
        return {name: Channel(np.frombuffer(values[name]), np.frombuffer(times[name])) for name in names}


def open_can_log(path: Path, dbc: Path) -> CanMeasurement:
    """A CAN log with the signals of a DBC.

    Raises:
        InputError: a DBC that cannot be read or has no signals.
    """
    import cantools

    try:
        base: Any = cantools.database.load_file(str(dbc))
    except OSError as error:
        raise InputError(dbc, "--dbc", f"a readable file ({error.strerror})") from error
    except (cantools.Error, ValueError) as error:
        reason = str(error).splitlines()
        raise InputError(dbc, "--dbc", f"a DBC file ({reason[0] if reason else type(error).__name__})") from error
    messages = {(m.frame_id, m.is_extended_frame): m for m in getattr(base, "messages", ())}
    units = {f"{m.name}.{s.name}": s.unit or "" for m in messages.values() for s in m.signals}
    if not units:
        raise InputError(dbc, "--dbc", "a DBC file with at least one signal")
    return CanMeasurement(path, f"CAN log, {dbc.name}", units, messages)

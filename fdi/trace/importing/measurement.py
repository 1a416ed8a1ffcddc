"""A foreign recording before its import: named channels of numbers, each with or without times of its own."""
from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError, suggest_name

Floats = NDArray[np.float64]


class Channel(NamedTuple):
    """A channel's samples, NaN where one is missing; times (s) where the file gives each channel its own."""

    values: Floats
    t: Floats | None = None


class Measurement(Protocol):
    """An open recording of another logger."""

    @property
    def path(self) -> Path:
        """The file."""

    @property
    def format(self) -> str:
        """For people: "CSV, separator ';', decimal comma, names in line 3"."""

    @property
    def units(self) -> Mapping[str, str]:
        """Channel to unit as the file has it, "" if it has none; all channels, in the file's order."""

    @property
    def has_times(self) -> bool:
        """Whether each channel has times of its own."""

    def read(self, names: Collection[str], dates: Collection[str] = ()) -> dict[str, Channel]:
        """The channels of these names; `dates` are calendar times and become seconds from the first one on.

        Raises:
            InputError: a value that is no number, naming its place.
        """


@dataclass(frozen=True)
class ArrayMeasurement:
    """A recording that is in memory as arrays."""

    path: Path
    format: str
    units: Mapping[str, str]
    channels: Mapping[str, Channel]
    has_times: bool = False

    def read(self, names: Collection[str], dates: Collection[str] = ()) -> dict[str, Channel]:
        """The channels of these names."""
        return {name: self.channels[name] for name in names}


def require_channel(measurement: Measurement, name: str, where: object, field: str) -> None:
    """Refuse a name that is no channel of the recording.

    Raises:
        InputError: it names the field of the map and the nearest channel.
    """
    if name not in measurement.units:
        shown = list(measurement.units)[:12]
        more = ", .." if len(measurement.units) > len(shown) else ""
        raise InputError(where, field, f"a column of {measurement.path.name} ({', '.join(shown)}{more}), "
                                       f"not {name!r}{suggest_name(name, measurement.units)}")

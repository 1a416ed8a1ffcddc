"""The JSON writer: plain Python values from numpy values, tuples and enumerations; null for NaN and infinity."""
from __future__ import annotations

import json
import math
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np


def to_json(data: Mapping[str, Any]) -> str:
    """The JSON text of an answer, in one line.

    >>> to_json({"error": np.float64(1.5), "ratio": float("nan"), "signals": ("xj", "p12")})
    '{"error": 1.5, "ratio": null, "signals": ["xj", "p12"]}'
    """
    return json.dumps(to_plain(data), allow_nan=False)


def to_plain(value: Any) -> Any:
    """A value as JSON can hold it: None for NaN and infinity, lists for tuples and arrays, dicts for mappings.

    A named tuple becomes a list, as `json` itself would write it; give its `_asdict()` where names are wanted.

    Raises:
        TypeError: a value of another type, which an answer must not hold.
    """
    if isinstance(value, np.ndarray | np.generic):
        return to_plain(value.tolist())
    if isinstance(value, Enum):
        return to_plain(value.value)
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    raise TypeError(f"{type(value).__name__} in an answer: {value!r}")

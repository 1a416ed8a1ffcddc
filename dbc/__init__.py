"""What the bus says, as data: `eha.dbc` decodes frames, one EDS per node is its object dictionary (CiA 306)."""
from __future__ import annotations

from importlib.resources import files
from pathlib import Path

__all__ = ["DBC", "EDS"]

_HERE = Path(str(files(__name__)))

DBC = _HERE / "eha.dbc"
EDS = {node: _HERE / f"node{node}.eds" for node in (1, 2, 3)}

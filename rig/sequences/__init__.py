"""Test sequences: the shipped ones as TOML, and what reads them, injects their faults and judges their checks."""
from rig.sequences.sequence import Sequence, load_sequence

__all__ = ["Sequence", "load_sequence"]

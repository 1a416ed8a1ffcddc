"""Loads python-can without asammdf, which it offers for MF4 logs and which loads pandas: a second a process."""

import sys

sys.modules["asammdf"] = None  # type: ignore[assignment]  # an import of it fails
import can  # noqa: E402, F401

del sys.modules["asammdf"]  # the tests of `rig import` load it

"""Files and folders of tests that `make quick` leaves out: each takes more than some 3 s."""
from __future__ import annotations

LONG_TESTS = ("vcan/", "newcomer/", "studies/")

"""A real ball-screw drive that others have measured (EMPS): its published parameters leave the published errors."""

from pathlib import Path

import pytest
from places import SHARED
from rig_command import answer

DATA = SHARED / "data" / "emps" / "DATA_EMPS.mat"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording as a trace."""
    if not DATA.exists():
        pytest.skip(f"{DATA} is not there")
    file = tmp_path_factory.mktemp("emps") / "emps.mcap"
    answer("import", DATA, "--out", file)
    return file


@pytest.mark.parametrize(("friction", "low", "high"), [(0.0, 0.30, 0.45), (20.39, 0.038, 0.043)])
def test_dry_friction_brings_the_error_of_the_force_to_the_published_one(
    recording: Path, friction: float, low: float, high: float
) -> None:
    """Published with dry friction: 4.08 %, 4.04 % where it was computed again. The model without it is not fitted."""
    found = answer("compare", recording, "--model", "emps", "--set", f"surface.friction={friction}", status=1)
    assert low < found["drive_error"] < high

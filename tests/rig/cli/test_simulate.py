"""`rig simulate`: whatever the model's cycle, the command takes the seconds it says."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from physics_cases import PREFLIGHT
from rig_command import answer, refuse


def simulated(folder: Path, *words: object) -> np.ndarray:
    """The trace of a simulation, by column."""
    told = answer("simulate", "--out", folder / "s.csv", *words)
    table = np.genfromtxt(folder / "s.csv", delimiter=",", names=True)
    assert (table.dtype.names, len(table)) == (("t", "com", "xj", "cor", "p12", "xs", "load"), told["cycles"])
    return table


def written(folder: Path, t: np.ndarray, com: np.ndarray, load: np.ndarray) -> Path:
    rows = "\n".join(f"{a:.4f},{b!r},{c!r}" for a, b, c in zip(t, com.tolist(), load.tolist(), strict=True))
    (folder / "c.csv").write_text(f"t,com,load\n{rows}\n")
    return folder / "c.csv"


@pytest.mark.parametrize("period", [0.0005, 0.001, 0.002])
def test_a_ramp_and_a_step_keep_their_seconds(period: float, tmp_path: Path) -> None:
    """A ramp of 5 mm/s for 0.3 s, then a step of 1 mm, and a load that comes with it."""
    t = np.arange(501) / 1000
    com, load = np.where(t < 0.3, 5e-3 * t, 2.5e-3), np.where(t < 0.3, 0.0, 2e3)
    run = simulated(tmp_path, "--command", written(tmp_path, t, com, load), f"--set=controller.period={period}")
    assert run["t"][-1] == pytest.approx(0.5, abs=0.001) and np.diff(run["t"]) == pytest.approx(period)
    row = np.floor(run["t"] * 1000 + 1e-6).astype(int)
    assert (run["com"] == com[row]).all() and (run["load"] == load[row]).all()
    late = run["t"] > 0.1
    speed = np.polyfit(run["t"][late & (run["t"] < 0.3)], run["xj"][late & (run["t"] < 0.3)], 1)[0]
    assert speed == pytest.approx(5e-3, rel=0.02)
    assert run["xj"][-1] == pytest.approx(2.5e-3, abs=50e-6)


def test_rows_at_the_models_period_are_the_command(tmp_path: Path) -> None:
    com = np.random.default_rng(0).standard_normal(50) * 1e-3
    t = np.arange(50) * 0.002
    run = simulated(tmp_path, "--command", written(tmp_path, t, com, 1e5 * com), "--set=controller.period=0.002")
    assert (run["com"] == com).all() and run["t"] == pytest.approx(t)


def test_the_command_file_is_never_overwritten(tmp_path: Path) -> None:
    file = written(tmp_path, np.arange(50) / 1000, np.zeros(50), np.zeros(50))
    before = file.read_text()
    assert "another file than the one that is read" in refuse("simulate", "--command", file, "--out", file)
    assert file.read_text() == before


@pytest.mark.parametrize(("period", "every"), [(0.001, 1), (0.002, 2), (0.01, 10)])
def test_the_preflight_lasts_as_long_as_ever(period: float, every: int, tmp_path: Path) -> None:
    run = simulated(tmp_path, f"--set=controller.period={period}")
    assert len(run) == 13_500 // every
    np.testing.assert_allclose(run["com"], PREFLIGHT[::every], atol=1e-15)
    assert np.abs(run["com"][run["t"] < 0.5]).max() == 0.0 and run["com"][round(0.5 / period)] == 5e-3

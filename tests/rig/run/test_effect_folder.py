"""Effect files of a log are removed, also after a run that was killed."""
from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path

import pytest

from rig.run.job import make_effect_folder, remove_left_folders


def test_the_folder_of_a_killed_run_is_removed_and_one_in_use_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left, foreign = tmp_path / "eha-rig-effects-left", tmp_path / "other-left"
    for folder in (left, foreign):
        folder.mkdir()
        (folder / "effect.py").write_text("")
        os.utime(folder, (0, 0))
    in_use = make_effect_folder()
    assert not left.exists() and foreign.exists()
    os.utime(in_use, (0, 0))
    remove_left_folders(tmp_path, 1.0)
    assert in_use.exists()


def test_a_link_of_that_name_is_left_alone(tmp_path: Path) -> None:
    """Anybody may make one in the shared folder for temporary files."""
    target = tmp_path / "precious"
    target.mkdir()
    (tmp_path / "eha-rig-effects-x").symlink_to(target)
    remove_left_folders(tmp_path, math.inf)
    assert target.exists()


def test_a_new_folder_is_not_removed_before_its_process_has_locked_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    new = tmp_path / "eha-rig-effects-new"
    new.mkdir()
    make_effect_folder()
    assert new.exists()

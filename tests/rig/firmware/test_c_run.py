"""Runs with the C firmware on the project's UDP bus: it is built, started and gives the numbers of the built-in one."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from bus_stations import spec
from c_device import STRICT, skip_without_compiler
from log_rows import describe_first_difference
from rig_command import nodes_on, rig
from short_sequences import job, play

from plant.errors import InputError, RigError
from rig.firmware.build import FOLDER, build_controller, build_program


def test_preflight_rows_are_byte_for_byte_those_of_the_builtin_controller(tmp_path: Path, preflight: Path) -> None:
    """On a CAN interface the same is asked in tests/vcan."""
    skip_without_compiler()
    where = spec("udp_multicast")
    said = rig("run", "--controller", "c", "--bus", where, "--json", "--out", tmp_path)
    assert said.status == 0, said.err
    assert said.json["verdict"] == "PASS"
    assert describe_first_difference(tmp_path, preflight) == "none in 14500 rows"
    assert nodes_on(where) == []


def test_gains_of_the_model_reach_the_firmware(tmp_path: Path) -> None:
    """With integral and derivative part and the output at its limit: the law has the same bits."""
    skip_without_compiler()
    gains = {"controller.proportional_gain": 9.0, "controller.integral_gain": 40.0, "controller.derivative_gain": 0.01,
             "controller.current_limit": 2e-3}  # fmt: skip
    play(job(set_=gains, seed=1), tmp_path / "builtin")
    outcome = play(job(set_=gains, seed=1, controller="c", bus=spec("udp_multicast")), tmp_path / "c")
    assert set(outcome.counters.values()) == {0}
    assert describe_first_difference(tmp_path / "c", tmp_path / "builtin").startswith("none in")


@pytest.mark.parametrize(("words", "path", "said"), [
    (["--set", "command_rate_limit.rate=0.05"], None, "builtin"),  # effects in the firmware
    *((["--bus", bus], None, "--bus") for bus in ("virtual", "embedded", "slcan:x")),  # no port for it
    (["--bus", "udp_multicast"], "/nowhere", "apt-get install gcc"),
])
def test_what_the_firmware_cannot_do_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str],
                                                 path: str | None, said: str) -> None:
    monkeypatch.setenv("PATH", path or os.environ["PATH"])
    answer = rig("run", "--controller", "c", *words, "--out", tmp_path)
    assert answer.status == 2 and said in answer.err and answer.err.count("\n") == 1


def test_it_is_compiled_once_and_again_when_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    skip_without_compiler()
    monkeypatch.setenv("EHA_RIG_CACHE", str(tmp_path / "cache"))
    program = build_controller()
    first = program.stat()
    assert build_controller() == program and program.stat().st_mtime_ns == first.st_mtime_ns
    folder = tmp_path / "sources"
    shutil.copytree(FOLDER, folder)
    (folder / "control_law.c").write_text((folder / "control_law.c").read_text() + "/* changed */\n")
    assert build_program("controller", sorted(folder.glob("*.c")), STRICT) != program
    assert sorted(path.name[:11] for path in (tmp_path / "cache").iterdir()) == ["controller-"] * 2


def test_an_error_of_the_compiler_is_one_line(tmp_path: Path) -> None:
    skip_without_compiler()
    (tmp_path / "bad.c").write_text("int main(void) { return x; }\n")
    with pytest.raises(RigError) as caught:
        build_program("bad", [tmp_path / "bad.c"], STRICT)
    assert "error" in str(caught.value) and "\n" not in str(caught.value)
    assert not isinstance(caught.value, InputError)


@pytest.mark.parametrize("words", [[], ["embedded"], ["socketcan"], ["socketcan:"], ["udp_multicast:x"], ["a", "b"]])
def test_the_program_says_what_it_needs(words: list[str]) -> None:
    skip_without_compiler()
    done = subprocess.run([build_controller(), *words], capture_output=True, text=True, timeout=20)
    assert done.returncode == 2 and done.stderr.count("\n") == 1

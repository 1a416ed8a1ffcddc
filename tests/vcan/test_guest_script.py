"""guest.sh --check says why the guest does not work; the shim lets it boot where UML's register buffer is too small."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from vcan_host import FOLDER, GUEST, kernel_has_vcan0, skip_or_fail

PANIC = "ptrace set fp regs failed, errno = 14"


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The shim, and the stand-in for a CPU with larger registers, built."""
    if shutil.which("gcc") is None:
        skip_or_fail("gcc is missing")
    folder = tmp_path_factory.mktemp("libraries")
    built = {name: folder / f"{name}.so" for name in ("xstate_shim", "small_xstate")}
    for name, library in built.items():
        options = ["-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
        subprocess.run(["gcc", *options, "-o", library, FOLDER / f"{name}.c", "-ldl"], check=True)
    return built


def check(home: Path, **settings: str | Path) -> tuple[int, str]:
    """Exit status and message of `guest.sh --check`, which remembers its successes in `home`."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(home), **{name: str(value) for name, value in settings.items()}}
    done = subprocess.run(["bash", GUEST, "--check"], env=environment, capture_output=True, text=True, timeout=120)
    assert done.stdout == ""
    return done.returncode, done.stderr


def need_guest() -> None:
    """Skip without the packages of the guest; CI does not install them where the kernel itself has vcan0."""
    path = os.environ["PATH"] + ":/usr/sbin:/sbin"
    if shutil.which("linux.uml") is None or shutil.which("insmod", path=path) is None:
        if kernel_has_vcan0():
            pytest.skip("the guest's packages are missing, and this kernel has vcan0")
        skip_or_fail("the guest's packages are missing")


def test_check_names_the_missing_package(tmp_path: Path) -> None:
    """A kernel that is not there."""
    assert_refused(check(tmp_path, GUEST_KERNEL="linux.missing"), "apt-get install user-mode-linux")


def assert_refused(checked: tuple[int, str], *words: str) -> None:
    """One line that has all the words."""
    status, message = checked
    assert status == 125 and message.count("\n") == 1
    assert [word for word in words if word not in message] == []


def test_check_says_why_a_guest_does_not_boot(tmp_path: Path, libraries: dict[str, Path]) -> None:
    """More memory than any folder has; a panic as on a CPU with AMX."""
    need_guest()
    assert_refused(check(tmp_path, GUEST_MEMORY="999999999"), "without noexec (tried /dev/shm")
    small = libraries["small_xstate"]
    assert_refused(check(tmp_path, LD_PRELOAD=small, GUEST_SHIM="no"), PANIC, "Kernel panic", "GUEST_SHIM=no")
    assert not list(tmp_path.iterdir()), "a failed boot is not remembered"


def test_a_guest_with_the_shim_boots_where_it_panics_without_and_is_remembered(
    tmp_path: Path, libraries: dict[str, Path]
) -> None:
    """The same stand-in; the second check does not boot."""
    need_guest()
    assert check(tmp_path, LD_PRELOAD=libraries["small_xstate"]) == (0, "")
    (proof,) = (file for file in tmp_path.rglob("*") if file.is_file())
    assert check(tmp_path, LD_PRELOAD=libraries["small_xstate"], TMPDIR="/nonexistent") == (0, "")
    proof.write_text("another boot")
    assert_refused(check(tmp_path, LD_PRELOAD=libraries["small_xstate"], TMPDIR="/nonexistent"))

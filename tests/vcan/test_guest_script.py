"""guest.sh --check says why the guest does not work; the shim lets it boot where UML's register buffer is too small."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from vcan_host import FOLDER, GUEST, kernel_has_vcan0, skip_or_fail

PANIC = "ptrace set fp regs failed, errno = 14"

# Writes a part of a stopped child's vector registers, as UML 6.1 does on a CPU with AMX, and reads all of them back.
WRITE_A_PART = """
import ctypes, os, signal
class Buffer(ctypes.Structure):
    _fields_ = [("base", ctypes.c_void_p), ("length", ctypes.c_size_t)]
TRACEME, CONT, GETREGSET, SETREGSET, XSTATE, PEEKDATA = 0, 7, 0x4204, 0x4205, 0x202, 2
library = ctypes.CDLL(None, use_errno=True)
library.ptrace.restype = ctypes.c_long
library.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
word = ctypes.c_long(0x1122334455667788)
child = os.fork()
if child == 0:
    library.ptrace(TRACEME, 0, None, None)
    os.kill(os.getpid(), signal.SIGSTOP)
    os._exit(7)
os.waitpid(child, 0)
def request(kind, area):
    buffer = Buffer(ctypes.addressof(area), len(area))
    status = library.ptrace(kind, child, XSTATE, ctypes.addressof(buffer))
    return status, ctypes.get_errno() if status else 0, buffer.length
before, after = bytearray(65536), bytearray(65536)
_, _, size = request(GETREGSET, (ctypes.c_char * 65536).from_buffer(before))
part = bytearray(before[:size - 64])                   # all but the last 64 bytes
part[160 + 16 * 7: 160 + 16 * 8] = b"sixteen of xmm7!"   # a register of the first part
part[512] |= 2                                           # and the sign that the SSE registers are in use
status, error, _ = request(SETREGSET, (ctypes.c_char * len(part)).from_buffer(part))
request(GETREGSET, (ctypes.c_char * 65536).from_buffer(after))
print("status", status, error)
print("written", after[160 + 16 * 7: 160 + 16 * 8] == b"sixteen of xmm7!")
print("rest kept", before[size - 64: size] == after[size - 64: size])
print("peek", library.ptrace(PEEKDATA, child, ctypes.addressof(word), None) == word.value)
library.ptrace(CONT, child, None, None)
print("child", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


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


def test_a_part_of_the_vector_registers_is_refused_without_the_shim_and_completed_with_it(
    libraries: dict[str, Path]
) -> None:
    """The kernel's own answer is EFAULT; the shim writes the part, keeps the rest, and passes other requests on."""
    command = [sys.executable, "-c", WRITE_A_PART]
    plain = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    if plain[0] == "status 0 0":
        pytest.skip("this machine's kernel takes a part of the vector registers")
    assert plain == ["status -1 14", "written False", "rest kept True", "peek True", "child 7"]
    environment = {**os.environ, "LD_PRELOAD": str(libraries["xstate_shim"])}
    shimmed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    assert shimmed == ["status 0 0", "written True", "rest kept True", "peek True", "child 7"]


def test_check_names_the_missing_package(tmp_path: Path) -> None:
    """A kernel that is not there."""
    assert_refused(check(tmp_path, GUEST_KERNEL="linux.missing"), "apt-get install user-mode-linux")


def assert_refused(checked: tuple[int, str], *words: str) -> None:
    """One line that has all the words."""
    status, message = checked
    assert status == 125 and message.count("\n") == 1
    assert [word for word in words if word not in message] == []


def test_check_says_why_a_guest_does_not_boot(tmp_path: Path, libraries: dict[str, Path]) -> None:
    """More memory than any folder has; a panic as on a CPU with AMX; no gcc where the shim is needed."""
    need_guest()
    assert_refused(check(tmp_path, GUEST_MEMORY="999999999"), "without noexec (tried /dev/shm")
    small = libraries["small_xstate"]
    assert_refused(check(tmp_path, LD_PRELOAD=small, GUEST_SHIM="no"), PANIC, "Kernel panic", "GUEST_SHIM=no")
    assert not list(tmp_path.iterdir()), "a failed boot is not remembered"
    tools = tmp_path / "tools"
    tools.mkdir()
    for folder in (*os.environ["PATH"].split(":"), "/usr/sbin", "/sbin"):
        for tool in Path(folder).glob("*"):
            if tool.name != "gcc" and not (tools / tool.name).is_symlink():
                (tools / tool.name).symlink_to(tool)
    assert_refused(check(tmp_path / "home", LD_PRELOAD=small, PATH=tools), PANIC, "apt-get install gcc")


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

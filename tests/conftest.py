"""Shared by all tests."""

import fcntl
import gc
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import light_can  # noqa: F401  before anything else loads python-can
import pytest
from bus_stations import spec
from effect_files import restored_catalogue
from hypothesis import HealthCheck, settings
from long_tests import LONG_TESTS, LONGEST
from plugin_bus import require_bus_kind
from rig_command import STARTED, rig

from plant.compile import _set_up_llvm

_set_up_llvm()  # before a test gives numba a function of its own: numba reads that setting once

pytest_plugins = ["plugin_bus", "pytester"]

# An example that took longer than hypothesis expects tells of the machine and not of the code.
settings.register_profile("shared machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared machine")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell script starts what it puts in the background with Ctrl-C ignored, and children inherit that. The tests of
    # Ctrl-C need it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --quick, which leaves out the files of `long_tests.LONG_TESTS`."""
    parser.addoption("--quick", action="store_true", help="without the tests that take long: enough for every edit")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The longest first, so that no worker is left with one; slow ones with -m alone, no long ones if --quick."""
    places = (*LONGEST, "")
    items.sort(key=lambda item: [item.nodeid.removeprefix("tests/").startswith(place) for place in places].index(True))
    for item in items:
        if not config.getoption("-m") and item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.skip(reason="takes long; -m slow runs it"))
    if config.getoption("--quick"):
        long = [item for item in items
                if item.path.relative_to(config.rootpath / "tests").as_posix().startswith(LONG_TESTS)]
        config.hook.pytest_deselected(items=long)
        items[:] = [item for item in items if item not in set(long)]


def pytest_collection_finish() -> None:
    """What was loaded so far stays: to look through it for garbage again and again took an eighth of the time."""
    gc.freeze()
    gc.set_threshold(50_000, 50, 50)


@pytest.fixture(autouse=True)
def leave_nothing() -> Iterator[None]:
    """A test leaves no effects (a search among others compiles kernels of its own), and where it fails no runs."""
    with restored_catalogue():
        yield
    while STARTED:
        STARTED.pop().kill()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the test, which is the present one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(params=["embedded", "virtual", "udp_multicast", "socketcan"])
def bus_kind(request: pytest.FixtureRequest) -> str:
    """The back end a bus test runs on. Without vcan0 the socketcan ones skip, or fail with EHA_RIG_REQUIRE_VCAN=1."""
    return require_bus_kind(request.param)


@pytest.fixture
def where(bus_kind: str) -> str:
    """A bus of that back end that nobody else uses."""
    return spec(bus_kind)


@pytest.fixture(scope="session")
def preflight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a real preflight run, not to be written to."""
    def run(folder: Path) -> None:
        assert rig("run", "--quiet", "--out", folder).status == 0

    return share_folder(tmp_path_factory, "preflight", run)


@pytest.fixture(scope="session")
def aborted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a real run with lost frames that a guard ended within a ramp; not to be written to."""
    def run(folder: Path) -> None:
        (folder / "guarded.toml").write_text(GUARDED)
        assert rig("run", folder / "guarded.toml", "--quiet", "--out", folder).status == 1

    return share_folder(tmp_path_factory, "aborted", run)


def share_folder(tmp_path_factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], None]) -> Path:
    """A folder that the first worker to ask for it fills for all of them."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # closing it, also by a kill, frees it
        if not folder.exists():
            part = folder.with_suffix(".part")
            part.mkdir(exist_ok=True)
            fill(part)
            part.rename(folder)
    return folder


GUARDED = """
title = "Guarded"
setup = [{ kind = "hold", time = 0.3 }]
main = [
  { name = "rest", kind = "hold", time = 0.5 },
  { name = "step 5 mm", kind = "step", to = 5e-3, time = 1.0 },
  { name = "ramp out", kind = "ramp", to = 9e-3, time = 2.0 },
  { name = "sine", kind = "sine", amplitude = 1e-3, frequency = 1.0, time = 2.0 },
]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.3 }]
faults = [
  { kind = "lost", frame = "feedback", start = 0.2, end = 0.5, every = 7 },
  { kind = "lost", frame = "feedback", start = 1.0, end = 1.002, every = 1 },
  { kind = "lost", frame = "valve_state", start = 0.6, end = 0.9, every = 1 },
]
checks = [
  { name = "overshoot", kind = "overshoot", window = "step 5 mm", high = 11 },
  { name = "ramp error", kind = "ramp_error", window = "ramp out", low = 0, high = 14, unit = "um" },
  { name = "gain, 1 Hz", kind = "amplitude_ratio", window = "sine", frequency = 1, low = 0.98 },
  { name = "lag, 1 Hz", kind = "phase_lag", window = "sine", frequency = 1, high = 4.5 },
  { name = "spool", kind = "never_exceeds", signal = "xs", high = 1, unit = "mm" },
  { name = "no emergency", kind = "event_never", event = "EMCY" },
]
guards = [{ name = "ram far out", signal = "xj", high = 6.5, unit = "mm" }]
"""

"""The stored machine code of a cycle: the same bits as numba's, and never in the way."""
from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from plant import Actuator, Model, machine_code
from plant.effects import CATALOGUE
from plant.machine_code import StoredCode
from plant.model import build_kernel
from plant.solve import advance_flat_state

RUN = """
import sys
import pytest

from plant import Actuator, Model, machine_code
effects = tuple(sys.argv[1:])
plant = Actuator(Model(effects=effects), seed=3)
plant.warm()
for k in range(400):
    plant.sample()
    plant.advance(5e-3 if k < 200 else -4e-3, 1e3)
print("numba" in sys.modules, plant._flat.tobytes().hex())
"""


def run_process(folder: Path, *effects: str) -> tuple[str, str]:
    """Whether a new process imported numba, and the state it came to."""
    done = subprocess.run([sys.executable, "-c", RUN, *effects], capture_output=True, text=True, check=True,
                          env={"EHA_RIG_CACHE": str(folder), "PATH": "/usr/bin:/bin"})
    imported, state = done.stdout.split()
    return imported, state


def test_the_second_process_runs_without_numba_to_the_same_bits(tmp_path: Path) -> None:
    assert "spool_friction" in CATALOGUE
    first, second = run_process(tmp_path, "spool_friction"), run_process(tmp_path, "spool_friction")
    assert (first[0], second[0]) == ("True", "False")
    assert first[1] == second[1]


def test_a_damaged_file_is_compiled_anew(tmp_path: Path) -> None:
    _, state = run_process(tmp_path)
    (stored,) = tmp_path.glob("*/advance.*.o")
    data = bytearray(stored.read_bytes())
    data[len(data) // 2] ^= 1
    stored.write_bytes(data)
    assert run_process(tmp_path) == ("True", state)
    stored.write_bytes(b"")
    assert run_process(tmp_path) == ("True", state)
    assert run_process(tmp_path) == ("False", state), "a damaged file is replaced"


def test_stored_code_equals_numba(tmp_path: Path) -> None:
    plant, other = Actuator(Model()), Actuator(Model())
    run = build_kernel(advance_flat_state, ())
    StoredCode(tmp_path, lambda: run).warm(plant._flat, plant._record)
    stored = StoredCode(tmp_path, lambda: None)  # nothing to fall back to
    advance = stored.bind(other._flat, other._record, other.steps)
    for k in range(300):
        advance(1e-3 * k, 10.0 * k, 0.1, 1e-3 * k)
        run(plant._flat, 1e-3 * k, 10.0 * k, 0.1, 1e-3 * k, plant._record, plant.steps)
        assert plant._flat.tobytes() == other._flat.tobytes()


def fail(run: object) -> bytes:
    """Another release of numba."""
    raise AttributeError("_get_module_for_linking")


@pytest.mark.parametrize(("name", "other"), [
    ("_link_object", lambda code: (None, lambda *arguments: 0)),  # code that moves nothing
    ("_emit_object", fail)])
def test_code_that_gives_other_bits_or_none_is_not_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str,
                                                          other: Callable[[object], object]) -> None:
    plant = Actuator(Model())
    run = build_kernel(advance_flat_state, ())
    monkeypatch.setattr(machine_code, name, other)
    StoredCode(tmp_path, lambda: run).warm(plant._flat, plant._record)
    assert list(tmp_path.iterdir()) == []

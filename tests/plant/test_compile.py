"""Compiled code: kept on disk, never stale, prepared when it is worth it; ways to run the plant agree bit for bit."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from effect_files import HEAD

from plant import (
    Actuator,
    Model,
    StoredCode,
    build_kernel,
    compile,
    find_cache_folder,
    machine_code,
)
from plant.solve import advance_flat_state

HOLD = HEAD + '''
SCALE = {scale}

class Hold(NamedTuple):
    share: Annotated[float, Quantity("1")] = 0.0

class Held(NamedTuple):
    demand: float = 0.0

@effect("command", Hold, law="a share of the last demand is held", memory=Held)
def hold(x, m, s, u, p):
    return x + SCALE * p.hold.share * (m.demand - x), Held(x)
'''

RUN = """
import json, sys
from pathlib import Path
import numpy as np
from plant import Model
from plant.run import compute_answers
from plant.effects import load_effects

file = Path(sys.argv[1])
load_effects(file)
if len(sys.argv) > 2:  # somebody edits it after it was read, before it is compiled
    file.write_text(Path(sys.argv[2]).read_text())
print(json.dumps(compute_answers(Model().replace({"hold.share": 0.4}), np.full(60, 1e-3), np.zeros((60, 3))).tolist()))
"""


def child(folder: Path, *arguments: Path) -> list[float]:
    done = subprocess.run([sys.executable, "-c", RUN, *map(str, arguments)], capture_output=True, text=True, check=True,
                          env=os.environ | {"EHA_RIG_CACHE": str(folder / "cache")})
    return json.loads(done.stdout)


def test_a_changed_effect_is_never_served_by_old_code_and_a_renamed_file_by_its_own(tmp_path: Path) -> None:
    """Kept code names the types of the memory by their module, which has the name of the user's file."""
    file, edited_file, renamed_file = (tmp_path / name for name in ("mine.py", "changed.py", "renamed.py"))
    file.write_text(HOLD.format(scale=1.0))
    edited_file.write_text(HOLD.format(scale=1.0).replace("SCALE * p", "2.0 * SCALE * p"))
    first = child(tmp_path, file, edited_file)  # compiled after the edit, from the code read before it
    second = child(tmp_path, file)  # the edited file
    assert first != second
    file.write_text(HOLD.format(scale=2.0))  # only a constant differs from the first
    assert child(tmp_path, file) == second
    renamed_file.write_text(HOLD.format(scale=1.0))
    assert child(tmp_path, renamed_file) == first


def test_fingerprint_sees_what_a_function_depends_on() -> None:
    def made(source: str, k: object = 1.0) -> str:
        scope = {"K": k}
        exec(source, scope)
        return compile.compute_fingerprint(scope["f"])

    base = "def f(x, y=1.0):\n    return x * K + g(x)\ndef g(x):\n    return x"
    closure = "def make(k):\n    return lambda x: x * k\nf = make(1.0)"
    table = np.zeros(5000)
    assert made(base) == made("# a remark\n" + base)
    for one, other in (((base,), (base, 2.0)), ((base,), (base + " + 1.0",)), ((base,), (base.replace("1.0", "2.0"),)),
                       ((base, table), (base, np.where(np.arange(5000) == 2500, 1.0, table))),  # where repr shows dots
                       ((closure,), (closure.replace("1.0", "2.0"),))):
        assert made(*one) != made(*other)


def test_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path))
    for eha_cache, xdg_cache, path in (("a", "b", "a"), ("", "b", "b/eha-rig"), ("", "", ".cache/eha-rig"),
                                       ("file/below", "b", None)):  # the last cannot be made: fall back
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / xdg_cache) if xdg_cache else "")
        monkeypatch.setenv("EHA_RIG_CACHE", str(tmp_path / eha_cache) if eha_cache else "")
        assert path is None or find_cache_folder() == tmp_path / path
    monkeypatch.setattr(compile.tempfile, "gettempdir", lambda: str(tmp_path))
    folder = tmp_path / f"eha-rig-{os.getuid()}"
    assert find_cache_folder() == folder
    folder.chmod(0o777)  # no code is loaded from a folder that others can write
    assert find_cache_folder() != folder and find_cache_folder() == find_cache_folder()
    assert find_cache_folder().stat().st_mode & 0o077 == 0
    folder.chmod(0o700)
    folder.rename(tmp_path / "other")
    folder.symlink_to(tmp_path / "other")
    assert find_cache_folder() != folder


COUNT_COMPILATIONS = """
from plant.compile import compile_function

def add_one(x):
    return x + 1.0

compiled = compile_function(add_one)
assert compiled(1.0) == 2.0
print(sum(compiled.stats.cache_misses.values()))
"""


def test_one_process_compiles_and_the_others_load_it(tmp_path: Path) -> None:
    (tmp_path / "count.py").write_text(COUNT_COMPILATIONS)
    environment = os.environ | {"EHA_RIG_CACHE": str(tmp_path / "code")}
    processes = [subprocess.Popen([sys.executable, str(tmp_path / "count.py")], env=environment, text=True,
                                  stdout=subprocess.PIPE) for _ in range(2)]
    assert sorted(process.communicate()[0].strip() for process in processes) == ["0", "1"]


RUN_PLANT = """
import sys
from plant import Actuator, Model
plant = Actuator(Model(), seed=3)
plant.warm()
for k in range(400):
    plant.sample()
    plant.advance(5e-3 if k < 200 else -4e-3, 1e3)
print("numba" in sys.modules, plant._flat.tobytes().hex())
"""


def run_process(folder: Path) -> tuple[str, str]:
    """Whether a new process imported numba, and the state it came to."""
    done = subprocess.run([sys.executable, "-c", RUN_PLANT], capture_output=True, text=True, check=True,
                          env={"EHA_RIG_CACHE": str(folder), "PATH": "/usr/bin:/bin"})
    imported, state = done.stdout.split()
    return imported, state


def test_the_second_process_runs_without_numba_to_the_same_bits_and_a_damaged_file_is_compiled_anew(tmp_path: Path
                                                                                                    ) -> None:
    imported, state = run_process(tmp_path)
    assert imported == "True" and run_process(tmp_path) == ("False", state)
    (object_file,) = tmp_path.glob("*/advance.*.o")
    data = bytearray(object_file.read_bytes())
    data[len(data) // 2] ^= 1
    object_file.write_bytes(data)
    assert run_process(tmp_path) == ("True", state)
    assert run_process(tmp_path) == ("False", state), "a damaged file is replaced"


def fail(run: object) -> bytes:
    """Another release of numba."""
    raise AttributeError("_get_module_for_linking")


@pytest.mark.parametrize(("name", "other"), [
    ("_make_entry", lambda engine, arguments: lambda *words: 0),  # code that moves nothing
    ("emit_object", fail)])
def test_code_that_gives_other_bits_or_none_is_not_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str,
                                                          other: Callable[[object], object]) -> None:
    plant = Actuator(Model())
    run = build_kernel(advance_flat_state, ())
    monkeypatch.setattr(machine_code, name, other)
    StoredCode(tmp_path, lambda: run).warm(lambda: (plant._flat.copy(), 5e-3, 0.0, 0.0, 0.0, plant._record, 10))
    assert list(tmp_path.iterdir()) == []

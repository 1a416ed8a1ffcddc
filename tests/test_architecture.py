"""The house rules that a machine can check: direction of imports, public names, docstrings, leftovers, pins."""

import ast
import builtins
import doctest
import fnmatch
import importlib
import io
import keyword
import re
import shutil
import subprocess
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from places import ROOT

PACKAGES = ("plant", "fdi", "rig", "dbc", "studies")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())

# The order of the packages; dbc is data only.
MAY_IMPORT = {"dbc": set(), "plant": {"plant"}, "fdi": {"plant", "fdi"}, "rig": {"plant", "fdi", "rig", "dbc"},
              "studies": {"plant", "fdi", "rig", "dbc", "studies"}}
# Single modules of fdi and rig, and what each may import; the folders stand in the table of ARCHITECTURE.md.
SHARED = {"fdi.output", "fdi.progress", "fdi.sources", "fdi.thresholds"}
SINGLE_MAY_IMPORT = {
    **{module: set() for module in SHARED},
    "fdi.foreign_code": set(),
    "fdi.analysis": {"fdi.foreign_code", "fdi.trace", "fdi.estimation", "fdi.comparison", "fdi.discovery",
                     "fdi.identification", "fdi.diagnosis", "fdi.prognosis", "fdi.report"},
    "rig.interrupts": set(),
    "rig.junit": {"rig.templates"},
    "rig.templates": set(),
    "rig.doctor": {"rig.benches", "rig.network", "rig.run"},
}


class Folder(NamedTuple):
    """A row of the table of folders."""

    path: str
    may_import: set[str]
    most: int  # statements


def read_folders() -> dict[str, Folder]:
    """The table of ARCHITECTURE.md by module name: `rig/network/` -> rig.network."""
    row = r"^\| `([a-z/]+)/` \| .+? \| (.*?) \| ([\d,]+) \| [\d,]+ \|$"
    rows = re.findall(row, (ROOT / "ARCHITECTURE.md").read_text(), re.MULTILINE)
    folders = {}
    for path, names, most in rows:
        modules = {name.removesuffix(".py").replace("/", ".") for name in re.findall(r"`([a-z_/.]+)`", names)}
        folders[path.replace("/", ".")] = Folder(path, modules, int(most.replace(",", "")))
    return folders


FOLDERS = read_folders()
# Modules of others that only some files may import (prefixes of paths).
ONLY_IN = {
    "numba": ("plant/compile.py",),
    "llvmlite": ("plant/machine_code.py", "plant/compile.py"),
    "can": ("rig/", "studies/"),
    "canopen": ("rig/",),
    "cantools": ("rig/",),
    "rerun": ("rig/",),
    "rich": ("rig/", "fdi/report/"),
    "mcap": ("rig/", "fdi/"),
    "matplotlib": ("fdi/", "rig/", "studies/"),
    "jax": ("studies/",),
    "progpy": ("studies/",),
    "sklearn": ("studies/",),
    "pygad": ("studies/",),
    "socket": ("rig/", "studies/"),
    "threading": ("rig/", "studies/", "plant/threads.py", "plant/kernel_use.py"),
    "asyncio": (),
    "random": ("studies/",),
    "tests": (),
    "pytest": (),
    "scipy": ("fdi/", "studies/"),
}
# The edge, where the wall clock may be seen; everything else is told the time.
CLOCK_MODULES = {"time", "datetime", "sched"}
CLOCK_FILES = (
    "studies/",
    "rig/benches/calibration.py", "fdi/prognosis/unit_trend.py",  # read dates; others give them the time
    "rig/bench/benchmarks.py",  # waits for a node to boot
    "rig/network/", "rig/run/loop.py", "rig/run/priority.py", "rig/cli/commands/",
    "rig/view/live_",  # a screen has a rate
    "rig/recorder/",  # its thread must close a chunk in time
    "rig/view/viewer.py",  # waits for the viewer to come up
)
# Public names of each package: what `from package import *` gives.
PUBLIC = {
    "plant": {"Actuator", "Columns", "InputError", "Model", "RigError", "load_model", "simulate"},
    "plant.effects": {"CATALOGUE", "Drag", "Effect", "Held", "Lag", "Law", "Line", "Quantity", "clip", "combine_laws",
                      "effect", "load_effects", "play", "register_base", "soften"},
    "fdi": {"Trace", "add_effect", "compare", "diagnose", "explain", "identify", "read_trace"},
    "fdi.discovery": {"Explanation", "explain"},
    "rig.device": {
        "Abort", "Device", "Dictionary", "EmcyCode", "ErrorRegister", "NmtCommand", "NmtState", "SdoAbort", "Value",
    },
    "rig.sequences": {"Sequence", "load_sequence"},
    "rig.recorder": {
        "U32", "CanFrame", "CycleBlock", "Event", "NmtState", "Observer", "Record", "Recorder",
        "RecorderError", "Signals", "Timing",
    },
    "dbc": {"DBC", "EDS"},
}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), name(path))


@cache
def nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(tree(path)))


def imported(path: Path) -> Iterator[str]:
    """Absolute names of all modules that a file imports, wherever in the file."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name(path)}:{node.lineno}: relative import"
            yield node.module or ""


def tracked() -> list[Path]:
    """Text files of the project: what git knows, or everything outside hidden and generated folders."""
    paths = []
    if (ROOT / ".git").exists() and shutil.which("git"):
        git = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
        paths = [ROOT / line for line in git.stdout.split("\0") if line]
    if not paths:
        folders = [*PACKAGES, "tests"]
        paths = [path for folder in folders for path in (ROOT / folder).rglob("*") if "__pycache__" not in path.parts]
    return [path for path in paths if path.is_file() and b"\0" not in path.read_bytes()[:4096]]


def test_imports_point_one_way() -> None:
    """plant <- fdi <- rig <- studies."""
    for path in MODULES:
        ours = {module.partition(".")[0] for module in imported(path)} & set(PACKAGES)
        assert ours <= MAY_IMPORT[path.relative_to(ROOT).parts[0]], name(path)


def folder(module: str) -> str:
    """The folder, or the single module, of fdi or rig that a module is in: `fdi.trace.csv_table` -> `fdi.trace`."""
    return ".".join(module.split(".")[:2])


def test_folders_import_only_lower_ones() -> None:
    """What a folder may import stands in ARCHITECTURE.md."""
    for path in MODULES:
        importer = folder(name(path).removesuffix(".py").replace("/", "."))
        package = importer.partition(".")[0]
        if package not in ("fdi", "rig") or importer.endswith(".__init__"):
            continue  # a package's face hands on what its folders have
        assert importer in FOLDERS or importer in SINGLE_MAY_IMPORT, f"{importer} has no place in the order of folders"
        if importer == "rig.cli":
            continue
        imports = {folder(module) for module in imported(path) if module.startswith(f"{package}.")} - {importer}
        lower_folders = FOLDERS[importer].may_import if importer in FOLDERS else SINGLE_MAY_IMPORT[importer]
        assert imports <= lower_folders | (SHARED if package == "fdi" and importer not in SHARED else set()), name(path)


def count_statements(path: Path) -> int:
    """Statements of a file's syntax tree, texts that stand alone (docstrings) not counted."""
    texts = [node for node in nodes(path) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
             and isinstance(node.value.value, str)]
    return sum(isinstance(node, ast.stmt) for node in nodes(path)) - len(texts)


def test_each_folder_keeps_its_budget() -> None:
    """The whole is as large as one person can hold: a folder that grows past its budget makes another part smaller."""
    counts = {folder.path: sum(map(count_statements, (ROOT / folder.path).rglob("*.py")))
              for folder in FOLDERS.values()}
    assert len(counts) > 20 and all(counts.values())
    assert {path: count for path, count in counts.items() if count > FOLDERS[path.replace("/", ".")].most} == {}


def test_private_names_stay_in_their_module() -> None:
    """What another module needs is public there, and has a docstring."""
    for path in MODULES:
        private_names = [alias.name for node in nodes(path) if isinstance(node, ast.ImportFrom) for alias in node.names
                         if alias.name.startswith("_")]
        assert private_names == [], name(path)


def test_imports_stay_in_their_place() -> None:
    """numba in one file, no CAN outside rig, no wall clock but at the edge."""
    for path in MODULES:
        for module in {module.partition(".")[0] for module in imported(path)}:
            places = CLOCK_FILES if module in CLOCK_MODULES else ONLY_IN.get(module, ("",))
            assert name(path).startswith(places or "nowhere"), f"{name(path)} imports {module}"


def test_public_names() -> None:
    """The packages offer exactly these names; a change of them is a decision, made here."""
    public_names = {}
    for path in MODULES:
        if path.name == "__init__.py":
            module = importlib.import_module(name(path.parent).replace("/", "."))
            names = set(getattr(module, "__all__", ()))
            defines = any(isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Assign) for node in tree(path).body)
            assert names or not defines or path.with_suffix(".pyi").exists(), f"{name(path)} has no __all__"
            assert [word for word in names if not hasattr(module, word)] == [], name(path)
            public_names |= {module.__name__: names} if names else {}
    assert public_names == PUBLIC


def test_one_address_for_each_name() -> None:
    """What the stub of a folder offers is used by other folders of fdi or rig, and imported from the folder alone."""
    imports = {(node.module, alias.name, path) for path in tracked() if path.suffix == ".py" for node in nodes(path)
               if isinstance(node, ast.ImportFrom) for alias in node.names}
    for stub in [path for path in tracked() if path.name == "__init__.pyi" and path.parent.name != "fdi"]:
        folder = name(stub.parent).replace("/", ".")
        stub_names = {(f"{folder}.{node.module}", alias.name) for node in nodes(stub)
                      if isinstance(node, ast.ImportFrom) for alias in node.names}
        assert [each for each in imports if each[:2] in stub_names and stub.parent not in each[2].parents] == []
        used_names = {word for module, word, path in imports
                      if module == folder and path.parts[len(ROOT.parts)] != "tests"}
        assert {word for _, word in stub_names} - used_names == set(), folder


def test_no_leftovers_and_no_machine_paths() -> None:
    """No notes to oneself, no folder of one machine, no host of a package registry."""
    notes = "|".join(["TO" + "DO", "FIX" + "ME", "X" * 3, "HA" + "CK"])
    hosts = "|".join(["pypi" + r"\.org", "pythonhosted" + r"\.org", "debian" + r"\.org", "npm" + r"js\."])
    bad = re.compile(rf"\b(?:{notes})\b|(?:{hosts})|(?<![\w.$}}~*-])/(?:work|root|home|tmp)/\w")
    leftovers = []
    for path in tracked():
        for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
            if bad.search(line):
                leftovers.append(f"{name(path)}:{number}: {line.strip()[:100]}")
    assert leftovers == []


def test_each_threshold_has_its_reason() -> None:
    """In fdi/thresholds.py a comment above each value says what it decides and why it is that large."""
    text = (ROOT / "fdi" / "thresholds.py").read_text()
    reasons = dict(re.findall(r"((?:^#.*\n)+)^([A-Z_0-9]+)\b.* = ", text, re.MULTILINE))
    assert list(reasons.values()) == re.findall(r"^([A-Z_0-9]+)\b.* = ", text, re.MULTILINE) and len(reasons) > 40
    for reason, word in reasons.items():
        assert len(reason) > 40 and not reason.startswith("# ---"), word


def requirements() -> list[str]:
    project = PROJECT["project"]
    extras = project["optional-dependencies"].values()
    return [*project["dependencies"], *(line for extra in extras for line in extra)]


def test_pins_have_both_bounds() -> None:
    """An old release that was never tried and a new one that breaks us are both kept out."""
    for line in [*requirements(), *PROJECT["build-system"]["requires"]]:
        assert re.fullmatch(r"[a-z0-9-]+>=[\d.]+,<[\d.]+", line), line


def test_each_dependency_is_explained() -> None:
    """ARCHITECTURE.md has a line '- `name`: why (licence)' for each dependency, and for nothing else."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    dependencies = {re.split("[<>=]", line)[0] for line in requirements()}
    assert set(re.findall(r"^\s*[-*] `([a-z0-9-]+)`: .+\(.+\)", text, re.MULTILINE)) == dependencies


def test_each_import_is_declared() -> None:
    """What another package happens to bring along today may be gone tomorrow."""
    distributions = {"can": "python-can", "mcap_protobuf": "mcap-protobuf-support", "google": "protobuf",
                     "rerun": "rerun-sdk", "llvmlite": "numba", "sklearn": "scikit-learn",
                     "lazy_loader": "lazy-loader"}  # numba pins llvmlite itself
    dependencies = {re.split("[<>=]", line)[0] for line in requirements()}
    for path in MODULES:
        if name(path).startswith("studies/"):
            continue  # a study says itself what it compares with
        for module in {module.partition(".")[0] for module in imported(path)}:
            is_exempt = module in sys.stdlib_module_names or module in PACKAGES
            assert is_exempt or distributions.get(module, module) in dependencies, f"{name(path)} imports {module}"


def test_each_dependency_is_used() -> None:
    """Nothing is installed for nothing."""
    modules = {"python-can": "can", "mcap-protobuf-support": "mcap_protobuf", "protobuf": "google",
               "lazy-loader": "lazy_loader"}
    imports = {module.partition(".")[0] for path in MODULES for module in imported(path)}
    for line in PROJECT["project"]["dependencies"]:
        distribution = re.split("[<>=]", line)[0]
        assert modules.get(distribution, distribution) in imports, distribution


def test_every_package_and_data_file_is_installed() -> None:
    """pyproject.toml lists each package, and a pattern for each file in it that is not Python."""
    tools = PROJECT["tool"]["setuptools"]
    folders = {path.parent for path in MODULES if path.name == "__init__.py" and not name(path).startswith("studies/")}
    assert sorted(tools["packages"]) == sorted(name(folder).replace("/", ".") for folder in folders)
    for folder in folders:
        patterns = tools["package-data"].get(name(folder).replace("/", "."), [])
        for path in folder.rglob("*"):
            is_data = path.is_file() and path.suffix not in {".py", ".pyc"}
            package = next(parent for parent in path.parents if parent in folders)  # of plant/models: plant
            if is_data and package == folder:
                below = path.relative_to(folder).as_posix()
                assert any(fnmatch.fnmatch(below, pattern) for pattern in patterns), f"{name(path)}: not installed"


FILES = sorted(path for package in ("plant", "fdi", "rig", "dbc") for path in (ROOT / package).rglob("*.py"))
NAME = re.compile(r"`([A-Za-z_][\w.]*)(?:\([^`]*\))?`")
# names of other programs, which this code neither defines nor uses
LIBRARIES = {*sys.stdlib_module_names, "numpy", "scipy", "can", "canopen", "mcap", "numba"}
FOREIGN = {*LIBRARIES, "resid", "array_split", "udp_multicast", "_asdict", "ro", "wo"}  # the last two: EDS


@cache
def split_source(source: str) -> tuple[str, set[str]]:
    """Docstrings and comments of a file, and the words of its code and of its other texts, such as keys of files."""
    nodes = list(ast.walk(ast.parse(source)))
    documented = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module)]
    docstrings = [text for node in documented if (text := ast.get_docstring(node, clean=False))]
    comments, words = list[str](), set[str]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments.append(token.string)
        elif token.type != tokenize.STRING or not any(text in token.string for text in docstrings):
            words |= set(re.split(r"\W+", token.string))
    return "\n".join((*docstrings, *comments)), words


@cache
def list_known_names() -> set[str]:
    """What Python, other programs and the project's code name, and the names of the project's files and folders."""
    code = {name for path in FILES for name in split_source(path.read_text())[1]}
    parts = {part for path in FILES for part in path.relative_to(ROOT).with_suffix("").parts}
    return {*dir(builtins), *keyword.kwlist} | FOREIGN | code | parts


def find_unknown_names(source: str) -> list[str]:
    """Names in backticks in the docstrings and comments of a file that nothing defines or uses."""
    text, words = split_source(source)
    known_names = list_known_names() | words
    return [name for name in NAME.findall(text) if not set(filter(None, name.split("."))) <= known_names]


def test_names_in_backticks_exist() -> None:
    unknown_names = {path.relative_to(ROOT).as_posix(): find_unknown_names(path.read_text()) for path in FILES}
    assert len(unknown_names) > 200 and {path: names for path, names in unknown_names.items() if names} == {}


def test_examples_in_docstrings_are_true() -> None:
    files = [path.relative_to(ROOT).with_suffix("") for path in FILES if ">>> " in path.read_text()]
    wrong = {str(file): doctest.testmod(importlib.import_module(".".join(file.parts))).failed for file in files}
    assert len(files) > 20 and not any(wrong.values()), wrong

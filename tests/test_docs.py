"""The documentation is complete, its links have targets, and its examples work."""

import argparse
import ast
import importlib
import inspect
import re
import runpy
import shlex
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from rig_command import rig

from plant import Model, load_model, simulate
from plant.effects import effect, load_effects
from plant.eha import State
from plant.parameters import GROUPS
from plant.quantity import list_quantities
from plant.state import Input
from rig.cli import main
from rig.cli.command_list import COMMANDS
from rig.sequences import faults
from rig.sequences.checks import KEYS, Guard
from rig.sequences.python_parts import Step
from rig.sequences.sequence import SEGMENT_KINDS, Sequence, parse_sequence

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]
SEQUENCES = (ROOT / "docs" / "sequences.md").read_text()


def indented_blocks(text: str) -> list[str]:
    """The indented blocks of a Markdown text, without their indentation."""
    found = re.findall(r"(?:^    .*\n(?:\s*\n(?=    ))?)+", text, re.MULTILINE)
    return [re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in found]


def documented_keys() -> Iterator[tuple[str, str]]:
    for kinds in (SEGMENT_KINDS, faults.KINDS, KEYS):
        for kind, cls in kinds.items():
            yield kind, kind
            yield from ((kind, f.name) for f in fields(cls) if f.metadata.get("key", True))
    yield from (("sequence", f.name) for f in fields(Sequence) if f.metadata.get("key", True))
    yield from (("guard", f.name) for f in fields(Guard) if f.metadata.get("key", True))
    yield from (("step", f.name) for f in fields(Step) if f.metadata.get("key", True))


def test_every_key_of_a_sequence_is_described() -> None:
    missing = [f"{key} of {where}" for where, key in sorted(set(documented_keys())) if f"`{key}`" not in SEQUENCES]
    assert missing == []


def test_the_example_of_a_model_file_is_valid(tmp_path: Path) -> None:
    """And what `to_toml` writes of it is the same model."""
    text = next(block for block in indented_blocks((ROOT / "docs" / "models.md").read_text())
                if block.startswith("name ="))
    (tmp_path / "unit.toml").write_text(text)
    model = load_model(tmp_path / "unit.toml")
    assert (model.name, set(model.effects)) == ("unit 7", {"null_bias", "quantisation"})
    assert {name for name in model.list_changes() if name.startswith("jack.")} == {
        "jack.static_friction", "jack.dynamic_friction"}
    (tmp_path / "again.toml").write_text(model.to_toml())
    assert load_model(tmp_path / "again.toml").values == model.values


def test_the_example_of_a_sequence_is_valid() -> None:
    text = next(block for block in indented_blocks(SEQUENCES) if block.startswith("title ="))
    sequence = parse_sequence(text, "example.toml", lambda name: b"")
    assert sequence.faults and sequence.checks and sequence.guards and sequence.load


def test_the_effects_in_the_manual_work(tmp_path: Path) -> None:
    """The worked example as a user goes through it: file, trial, simulation."""
    text = (ROOT / "docs" / "effects.md").read_text()
    code = [block for block in indented_blocks(text) if re.match(r"# my_effects\.py|class ", block)]
    assert all(len(block.splitlines()) <= 25 for block in code)
    (tmp_path / "my_effects.py").write_text("\n".join(code))
    assert load_effects(tmp_path / "my_effects.py") == ["seal_drag", "rod_play"]
    said = rig("effects", "--effects", tmp_path / "my_effects.py", "seal_drag")
    assert said.status == 0 and "seal_drag: exact at its off value" in said.out
    for row in re.findall(r"^    (level = .*)", text, re.MULTILINE):
        assert " ".join(row.split()) in " ".join(said.out.split())
    command = np.full(100, 1e-3)
    plain, loose = (simulate(model, command).xj for model in (Model(), Model().replace({"rod_play.width": 1e-4})))
    assert np.abs(plain - loose).max() > 1e-5
    for port in load_model().kind.ports:
        assert f"| `{port}` |" in text
    for field in (*State._fields, *Input._fields):
        assert f"`{field}`" in text
    for argument in inspect.signature(effect).parameters.keys() - {"port", "group", "law", "memory", "more"}:
        assert f"| `{argument}` |" in text


def test_the_readme_names_only_commands_that_exist_and_all_of_them() -> None:
    typed = re.findall(r"\brig ([a-z]+)\b", "\n".join(indented_blocks(README)))
    assert {*typed, *re.findall(r"`rig ([a-z]+)", README)} == set(COMMANDS)


def test_every_page_is_linked() -> None:
    text = README + (ROOT / "ARCHITECTURE.md").read_text()
    assert [page.name for page in (ROOT / "docs").glob("*.md") if f"docs/{page.name}" not in text] == []


def test_every_link_has_a_target() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"


def test_files_and_names_in_the_text_exist() -> None:
    for page in PAGES:
        text = page.read_text()
        for path in re.findall(r"`((?:plant|fdi|rig|dbc|tests|docs)/[\w./]*)`", text):
            assert (ROOT / path).exists(), f"{page.name}: {path}"
        for dotted in re.findall(r"`((?:plant|fdi|rig)(?:\.\w+)+)", text):
            module, _, attribute = dotted.rpartition(".")
            assert hasattr(importlib.import_module(module), attribute), f"{page.name}: {dotted}"


def test_every_figure_has_a_caption() -> None:
    """A line in italics below the figure that says what to see in it."""
    for page in PAGES:
        lines = page.read_text().splitlines()
        for number, line in enumerate(lines):
            if line.startswith("!["):
                assert not lines[number + 1] and lines[number + 2].startswith("*"), f"{page.name}: {line}"


def commands_shown(page: Path) -> list[str]:
    """The lines of a page that a user types, without the remark behind them."""
    lines = [line for block in indented_blocks(page.read_text()) for line in block.splitlines()]
    return [re.split(r"\s{2,}#", line)[0] for line in lines if line.startswith("rig ")]


@pytest.mark.parametrize("page", [page for page in PAGES if commands_shown(page)], ids=lambda page: page.name)
def test_the_commands_shown_are_accepted(page: Path) -> None:
    for line in commands_shown(page):
        print(line)  # a refusal ends the test, and this is then the last line that is shown
        parse_command(line)


def parse_command(line: str) -> argparse.Namespace:
    """The options of a command line, as `rig` reads them."""
    _, name, *words = shlex.split(line)
    return main.build_command_parser(name).parse_intermixed_args(words)


def values(args: argparse.Namespace, *names: str) -> list[str]:
    found = [getattr(args, name, None) for name in names]
    words = [word for value in found if value for word in (value if isinstance(value, list) else [value])]
    return [str(word) for word in words]


def test_a_command_of_the_tutorial_uses_only_what_is_there_by_then() -> None:
    there = {path.name for path in (ROOT / "docs" / "tutorial").iterdir()}
    effects = {"null_bias", "jack_friction", "missing_force"}
    typed = commands_shown(ROOT / "docs" / "tutorial.md")
    assert len(typed) > 10
    for line in typed:
        args = parse_command(line)
        used = values(args, "trace", "words", "repeat", "holdout", "effects", "model", "command_file")
        assert set(used) - effects - {"eha"} <= there, line
        there |= set(values(args, "out", "write_effect"))


@pytest.mark.parametrize("script", sorted((ROOT / "docs").glob("*.py")), ids=lambda path: path.name)
def test_the_scripts_of_the_pages_can_be_imported(script: Path) -> None:
    """They take minutes to run; a name that has moved shows in their imports and in what they use of a module."""
    names = runpy.run_path(str(script), run_name="imported")
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = names.get(node.value.id)
            assert not inspect.ismodule(owner) or hasattr(owner, node.attr), f"{node.value.id}.{node.attr}"


PHYSICS = (ROOT / "docs" / "physics.md").read_text()
SYMBOLS = re.findall(r"^\|\s*(\S*?)\s*\| `([a-z_]+\.[a-z_]+)`[^|]*\| ([^|]+) \|", PHYSICS, re.MULTILINE)


def test_the_table_of_symbols_has_every_parameter_and_its_symbol() -> None:
    known = {name: list_quantities(GROUPS[name.split(".")[0]])[name.split(".")[1]].symbol
             for name in Model().list_names()}
    assert {name: symbol for symbol, name, _ in SYMBOLS} == known


def test_the_table_of_symbols_has_the_nominal_values() -> None:
    shown = {name: float(value) for _, name, value in SYMBOLS if name != "filter.law"}
    assert shown == pytest.approx({name: Model()[name] for name in shown}, rel=2e-3)


def test_the_glossary_has_every_verdict() -> None:
    glossary = (ROOT / "docs" / "glossary.md").read_text()
    schemas = "".join(path.read_text() for path in (ROOT / "docs" / "schema").glob("*.json"))
    verdicts = set(re.findall(r'"([A-Z_]{4,})"', "".join(re.findall(r'"verdict": \{[^}]*"enum": \[[^]]*', schemas))))
    assert len(verdicts) > 15
    assert not [word for word in verdicts if not re.search(rf"\b{word}\b", glossary)]


def test_the_glossary_explains_a_term_once() -> None:
    glossary = (ROOT / "docs" / "glossary.md").read_text().split("## Verdict words")[0]
    terms = [term.strip() for row in re.findall(r"^- \*\*(.+?)\*\*: ", glossary, re.MULTILINE)
             for term in row.split(",")]
    assert len(terms) > 100 and len(terms) == len(set(terms))

"""What the documentation says is there, is there; what it shows, works."""
from __future__ import annotations

import argparse
import inspect
import re
import shlex
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from rig_command import rig

from plant import Model, segments, simulate
from plant.effects import CATALOGUE, effect, load_effects
from plant.state import Input, Ports, State
from rig.cli import main
from rig.cli.command_list import HELP_OF_COMMAND
from rig.sequences import checks, faults
from rig.sequences.guards import Guard
from rig.sequences.sequence import Sequence, parse_sequence

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
SEQUENCES = (ROOT / "docs" / "sequences.md").read_text()


def blocks(text: str) -> list[str]:
    """The indented blocks of a Markdown text, without their indentation."""
    found = re.findall(r"(?:^    .*\n(?:\s*\n(?=    ))?)+", text, re.MULTILINE)
    return [re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in found]


def keys() -> Iterator[tuple[str, str]]:
    for kinds in (segments.KINDS, faults.KINDS, checks.KINDS):
        for kind, cls in kinds.items():
            yield kind, kind
            yield from ((kind, f.name) for f in fields(cls) if f.metadata.get("key", True))
    yield from (("sequence", f.name) for f in fields(Sequence) if f.metadata.get("key", True))
    yield from (("guard", f.name) for f in fields(Guard))


@pytest.mark.parametrize(("where", "key"), sorted(set(keys())))
def test_every_key_of_a_sequence_is_described(where: str, key: str) -> None:
    assert re.search(rf"`{key}`", SEQUENCES), f"docs/sequences.md says nothing about {key} of {where}"


def test_the_sequence_in_the_readme_is_one() -> None:
    text = next(block for block in blocks(README) if block.startswith("title ="))
    sequence = parse_sequence(text, "readme.toml", lambda name: b"")
    assert sequence.faults and sequence.checks and sequence.guards and sequence.load


def test_the_effect_in_the_readme_is_one(tmp_path: Path) -> None:
    text = next(block for block in blocks(README) if block.startswith("# my_effects.py")).split("\nrig ")[0]
    (tmp_path / "my_effects.py").write_text(text)
    try:
        assert load_effects(tmp_path / "my_effects.py") == ["cogging"]
        command = np.full(50, 1e-3)
        plain, cogged = (simulate(model, command).xj for model in (Model(), Model().replace({"cogging.force": 2e3})))
        assert np.abs(plain - cogged).max() > 1e-6
    finally:
        CATALOGUE.pop("cogging", None)


def test_the_effects_in_the_manual_are_ones(tmp_path: Path) -> None:
    """The worked example as a user goes through it: file, trial, simulation."""
    text = (ROOT / "docs" / "effects.md").read_text()
    code = [block for block in blocks(text) if re.match(r"# my_effects\.py|class ", block)]
    assert all(len(block.splitlines()) <= 25 for block in code)
    (tmp_path / "my_effects.py").write_text("\n".join(code))
    try:
        assert load_effects(tmp_path / "my_effects.py") == ["seal_drag", "rod_play"]
        said = rig("effects", "--effects", tmp_path / "my_effects.py", "seal_drag")
        assert said.status == 0 and "sound seal_drag" in said.out
        for row in re.findall(r"^    (level = .*)", text, re.MULTILINE):
            assert " ".join(row.split()) in " ".join(said.out.split())
        command = np.full(100, 1e-3)
        plain, loose = (simulate(model, command).xj for model in (Model(), Model().replace({"rod_play.width": 1e-4})))
        assert np.abs(plain - loose).max() > 1e-5
        for port in Ports._fields:
            assert f"| `{port}` |" in text
        for field in (*State._fields[:-1], *Input._fields):
            assert f"`{field}`" in text
        for argument in inspect.signature(effect).parameters.keys() - {"port", "group", "law", "memory", "more"}:
            assert f"| `{argument}` |" in text
    finally:
        for name in ("seal_drag", "rod_play"):
            CATALOGUE.pop(name, None)


def test_the_readme_names_only_commands_that_exist_and_all_of_them() -> None:
    said = set(re.findall(r"\brig ([a-z]+)\b", "\n".join(blocks(README)))) | set(re.findall(r"`rig ([a-z]+)", README))
    assert said == set(HELP_OF_COMMAND)


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs").glob("*.md")))
def test_every_page_is_linked(page: str) -> None:
    assert f"docs/{page}" in README + (ROOT / "ARCHITECTURE.md").read_text()


def test_every_link_leads_somewhere() -> None:
    for page in [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"


TUTORIAL = ROOT / "docs" / "tutorial.md"
TYPED = [line for block in blocks(TUTORIAL.read_text()) for line in block.splitlines() if line.startswith("rig ")]


def values(args: argparse.Namespace, *names: str) -> list[str]:
    found = [getattr(args, name, None) for name in names]
    return [str(word) for value in found for word in (value if isinstance(value, list) else [value] if value else [])]


@pytest.mark.parametrize("line", TYPED)
def test_the_commands_of_the_tutorial_are_accepted(line: str) -> None:
    main.build_parser().parse_args(shlex.split(line)[1:])


def test_a_command_of_the_tutorial_uses_only_what_is_there_by_then() -> None:
    there = {path.name for path in (ROOT / "docs" / "tutorial").iterdir()}
    effects = {"null_bias", "jack_friction", "discovered"}
    for line in TYPED:
        args = main.build_parser().parse_args(shlex.split(line)[1:])
        used = values(args, "trace", "words", "repeat", "holdout", "effects", "model", "command_file")
        assert set(used) - effects - {"eha"} <= there, line
        there |= set(values(args, "out", "write_effect"))

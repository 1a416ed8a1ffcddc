"""The site of the docs: every page is in it, every link has a target, it needs no network, and its notebook runs."""

import importlib.util
import json
import re
from pathlib import Path

import pytest
from build_site import NAVIGATION, build_site, compare_navigation
from check_site import find_faults
from effect_files import restored_catalogue
from notebook_page import RunCell, check_format, run_notebook
from places import ROOT
from reference_pages import write_reference

from plant.model import list_offered_effects
from plant.plants import list_plants
from rig.cli.command_list import COMMANDS
from rig.conformance.run_cases import CASES
from rig.sequences import faults
from rig.sequences.checks import KINDS
from rig.sequences.sequence import SEGMENT_KINDS

NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
PAGES = {path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").glob("*.md")}
MADE = {f"docs/{NOTEBOOK.stem}.md", "ARCHITECTURE.md", "CHANGELOG.md",
        *(path.relative_to(ROOT).as_posix() for name in ("examples", "studies")
          for path in (ROOT / name).rglob("README.md"))}


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "reference"
    write_reference(folder)
    return folder


@pytest.fixture(scope="module")
def cells() -> list[RunCell]:
    """The notebook, run with a few effects to search among."""
    with restored_catalogue("null_bias", "constant_load", "spool_friction", "jack_friction"):
        return run_notebook(NOTEBOOK)


def test_every_page_is_in_the_navigation(reference: Path) -> None:
    known = PAGES | MADE | {path.relative_to(reference.parent).as_posix() for path in reference.rglob("*.md")}
    assert compare_navigation(known) == []
    assert compare_navigation(known | {"docs/new.md"}) == ["docs/new.md: not in docs/site/navigation.toml"]
    assert compare_navigation(known - {"docs/bus.md"}) == [
        "docs/bus.md: in docs/site/navigation.toml, but there is no such page"]
    assert [part["title"] for part in NAVIGATION] == ["Tutorial", "How-to", "Reference", "Explanation"]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_page_of_a_command_has_what_its_help_has(
        command: str, reference: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rig.cli.main import main

    with pytest.raises(SystemExit):
        main([command, "--help"])
    page = (reference / "commands" / f"{command}.md").read_text()
    options = set(re.findall(r"^ +(?:-\w, )?(--[a-z][\w-]+)", capsys.readouterr().out, re.MULTILINE))
    assert {"--help", "--json", "--out"} <= options
    assert {option for option in options if f"`{option}" not in page} == set()


def test_the_reference_has_every_effect_key_and_kind(reference: Path) -> None:
    sections = re.findall(r"^##+ (.*)", (reference / "effects.md").read_text(), re.MULTILINE)
    assert {effect.name for plant in list_plants() for effect in list_offered_effects(plant)} == set(sections)
    sections = re.findall(r"^##+ (.*)", (reference / "sequences.md").read_text(), re.MULTILINE)
    for word, kinds in (("Segment", SEGMENT_KINDS), ("Fault", faults.KINDS), ("Check", KINDS)):
        assert {f"{word} {name}" for name in kinds} <= set(sections)
    assert "| `filter.clogging` |" in (reference / "parameters.md").read_text()
    page = (reference / "conformance.md").read_text()
    assert [each.number for each in CASES] == re.findall(r"^\| (\d+\.\d+) \|", page, re.MULTILINE)
    keys = (reference / "json.md").read_text()
    assert all(f"## {path.name}" in keys for path in (ROOT / "docs" / "schema").glob("*.json"))
    assert "| `signals.*.floor_source` | `repeats`, `model`, `data`" in keys
    assert "```{py:function} compare(trace: TraceOrPath" in (reference / "python.md").read_text()


def test_the_site_is_whole_and_needs_no_network(cells: list[RunCell], tmp_path: Path) -> None:
    missing = [name for name in ("sphinx", "myst_parser", "pydata_sphinx_theme") if not importlib.util.find_spec(name)]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)} (pip install 'eha-rig[docs]')")
    site = tmp_path / "site"
    assert build_site(site, {NOTEBOOK: cells}) == []
    pages = {path.relative_to(site).with_suffix(".md").as_posix() for path in site.rglob("*.html")}
    assert pages >= PAGES | MADE | {"index.md", "search.md", *(page for part in NAVIGATION for page in part["pages"])}
    index = (site / "searchindex.js").read_text()
    assert '"stribeck"' in index and "Search.setIndex(" in index
    shown = (site / "docs" / f"{NOTEBOOK.stem}.html").read_text()
    assert shown.count('.svg"') == 2 and "truth 50 uA" in shown


def test_what_is_wrong_with_a_site_is_found(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(
        '<link rel="stylesheet" href="//cdn.example.org/a.css"><script src="https://example.org/a.js"></script>'
        '<a href="other.html#there">a</a><a href="other.html#gone">b</a><a href="gone.html">c</a>'
        '<a href="https://example.org">leads out</a><img src="gone.svg">')
    (tmp_path / "other.html").write_text('<p id="there"></p>')
    (tmp_path / "a.css").write_text("@font-face {src: url('https://example.org/f.woff2')}")
    assert find_faults(tmp_path) == [
        "index.html: loads //cdn.example.org/a.css from a network",
        "index.html: loads https://example.org/a.js from a network",
        "index.html: other.html#gone: no such anchor", "index.html: gone.html: no such file",
        "index.html: gone.svg: no such file", "a.css: loads https://example.org/f.woff2 from a network"]


def test_the_notebook_finds_the_effect_and_the_error_falls(cells: list[RunCell]) -> None:
    said = "".join(cell.printed for cell in cells)
    assert "EXPLAINED null_bias explains the residual" in said
    ratios = [float(value) for value in re.findall(r"([\d.]+) times the noise floor", said)]
    assert len(ratios) == 2 and ratios[0] > 20.0 and 0.8 < ratios[1] < 1.2
    ((value, low, high),) = (map(float, found) for found in
                             re.findall(r"null bias ([\d.]+) uA \(([\d.]+) \.\. ([\d.]+)\)", said))
    assert low < 50.0 < high and abs(value - 50.0) < 1.0
    assert sum(str(cell.value).startswith("<svg") for cell in cells) == 2


def test_the_notebook_is_stored_without_results() -> None:
    assert check_format(json.loads(NOTEBOOK.read_text())) == []

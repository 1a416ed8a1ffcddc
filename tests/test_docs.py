"""The documentation is complete and true, its examples work, it becomes a site; the schemas of the JSON answers."""

import ast
import importlib.util
import inspect
import json
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answer_schemas import build_validator, check_answer, load_schemas, name_schema
from build_site import NAVIGATION, build_site, compare_navigation
from check_site import find_faults
from effect_files import restored_catalogue
from jsonschema import Draft202012Validator
from notebook_page import RunCell, check_format, run_notebook
from places import ROOT
from reference_pages import write_reference
from rig_command import rig, write_file
from short_runs import HIDDEN, write_measured_runs

from plant import Input, Model, find_plant, list_plants, load_model, simulate
from plant.effects import effect, load_effects
from plant.eha import State
from plant.parameters import GROUPS
from plant.quantity import list_quantities
from rig.cli import main
from rig.cli.command_list import COMMANDS
from rig.conformance.run_cases import CASES
from rig.sequences import SEGMENT_KINDS, Guard, Sequence, Step, faults, parse_sequence
from rig.sequences.checks import KEYS, KINDS

README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]
SEQUENCES = (ROOT / "docs" / "sequences.md").read_text()


def indented_blocks(text: str) -> list[str]:
    """The indented blocks of a Markdown text, without their indentation."""
    return [re.sub(r"^    ", "", block, flags=re.MULTILINE)
            for block in re.findall(r"(?:^    .*\n(?:\s*\n(?=    ))?)+", text, re.MULTILINE)]


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
    model = load_model(write_file(tmp_path / "unit.toml", text))
    assert (model.name, set(model.effects)) == ("unit 7", {"null_bias", "quantisation"})
    assert {name for name in model.list_changes() if name.startswith("jack.")} == {
        "jack.static_friction", "jack.dynamic_friction"}
    assert load_model(write_file(tmp_path / "again.toml", model.to_toml())).values == model.values


def test_the_example_of_a_sequence_is_valid() -> None:
    text = next(block for block in indented_blocks(SEQUENCES) if block.startswith("title ="))
    sequence = parse_sequence(text, "example.toml", lambda name: b"")
    assert sequence.faults and sequence.checks and sequence.guards and sequence.load


def test_the_effects_in_the_manual_work(tmp_path: Path) -> None:
    """The worked example as a user goes through it: file, trial, simulation."""
    text = (ROOT / "docs" / "effects.md").read_text()
    code = [block for block in indented_blocks(text) if re.match(r"# my_effects\.py|class ", block)]
    assert all(len(block.splitlines()) <= 25 for block in code)
    file = write_file(tmp_path / "my_effects.py", "\n".join(code))
    assert load_effects(str(file)) == ["seal_drag", "rod_play"]
    result = rig("effects", "--effects", file, "seal_drag")
    assert result.status == 0 and "seal_drag: exact at its off value" in result.out
    for row in re.findall(r"^    (level = .*)", text, re.MULTILINE):
        assert " ".join(row.split()) in " ".join(result.out.split())
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


every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@every_page
def test_every_link_has_a_target(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        assert target.startswith("http") or (page.parent / target).exists(), target


@every_page
def test_files_and_names_in_the_text_exist(page: Path) -> None:
    text = page.read_text()
    for path in re.findall(r"`((?:plant|fdi|rig|dbc|tests|docs)/[\w./]*)`", text):
        assert (ROOT / path).exists(), path
    for dotted in re.findall(r"`((?:plant|fdi|rig)(?:\.\w+)+)", text):
        module, _, attribute = dotted.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), dotted


@every_page
def test_every_figure_has_a_caption(page: Path) -> None:
    """A line in italics below the figure that says what to see in it."""
    lines = page.read_text().splitlines()
    for number, line in enumerate(lines):
        if line.startswith("!["):
            assert not lines[number + 1] and lines[number + 2].startswith("*"), line


def commands_shown(page: Path) -> list[str]:
    """The lines of a page that a user types, without the remark behind them."""
    lines = [line for block in indented_blocks(page.read_text()) for line in block.splitlines()]
    return [re.split(r"\s{2,}#", line)[0] for line in lines if line.startswith("rig ")]


@pytest.mark.parametrize("page", [page for page in PAGES if commands_shown(page)], ids=lambda page: page.name)
def test_the_commands_shown_are_accepted(page: Path) -> None:
    for line in commands_shown(page):
        print(line)  # a refusal ends the test, and this is then the last line that is shown
        _, name, *words = shlex.split(line)
        main.build_command_parser(name).parse_intermixed_args(words)


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
    symbols = {name: list_quantities(GROUPS[name.split(".")[0]])[name.split(".")[1]].symbol
               for name in Model().list_names()}
    assert {name: symbol for symbol, name, _ in SYMBOLS} == symbols


def test_the_table_of_symbols_has_the_nominal_values() -> None:
    values = {name: float(value) for _, name, value in SYMBOLS if name != "filter.law"}
    assert values == pytest.approx({name: Model()[name] for name in values}, rel=2e-3)


def test_the_glossary_has_every_verdict() -> None:
    glossary = (ROOT / "docs" / "glossary.md").read_text()
    schemas = "".join(path.read_text() for path in (ROOT / "docs" / "schema").glob("*.json"))
    verdicts = set(re.findall(r'"([A-Z_]{4,})"', "".join(re.findall(r'"verdict": \{[^}]*"enum": \[[^]]*', schemas))))
    assert len(verdicts) > 15
    assert not [word for word in verdicts if not re.search(rf"\b{word}\b", glossary)]


EXAMPLES = ROOT / "examples"


def test_the_page_lists_every_program() -> None:
    page = (EXAMPLES / "README.md").read_text()
    assert [path.name for path in EXAMPLES.glob("*.py") if f"({path.name})" not in page] == [] == (
        re.findall(r"rig run --bench \S+/bench.toml(?! --controller external --bus udp_multicast:)", page))


def test_an_effect_of_ones_own() -> None:
    result = rig("effects", "--effects", EXAMPLES / "cogging.py", "cogging")
    assert result.status == 0 and "F sin(2 pi XJ / pitch)" in result.out


def test_a_sequence_with_own_profile_and_measure(tmp_path: Path) -> None:
    result = rig("run", EXAMPLES / "growing_sine.toml", "--out", tmp_path / "run", "--json")
    assert result.status == 0 and result.json["verdict"] == "PASS"
    checks = {check["name"]: check for check in result.json["checks"]}
    assert 0.0 < checks["RMS error"]["value"] < 500.0 and checks["no emergency"]["passed"]


def test_tests_of_a_controller(tmp_path: Path) -> None:
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", str(EXAMPLES / "test_controller.py")]
    done = subprocess.run([sys.executable, *words,
                           "--rig-out", str(tmp_path / "results")], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


def test_missing_physics_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                  capsys: pytest.CaptureFixture[str]) -> None:
    """The program on shorter recordings than those of `rig simulate --samples`; among all effects its search takes a
    minute.
    """
    def write_samples(words: list[str], cwd: Path, check: bool) -> None:
        assert words[-3:] == ["simulate", "--samples", "--quiet"]
        for file, name in zip(write_measured_runs(cwd, HIDDEN).values(), ("run", "run2", "held"), strict=True):
            file.rename(cwd / f"{name}.csv")

    program = str(EXAMPLES / "find_missing_physics.py")
    monkeypatch.setattr(sys, "argv", [program, str(tmp_path)])
    monkeypatch.setattr(subprocess, "run", write_samples)
    with restored_catalogue("null_bias", "constant_load", "spool_friction", "jack_friction"):
        runpy.run_path(program, run_name="__main__")
    message = capsys.readouterr().out
    assert "null_bias" in message and message.rstrip().endswith("WITHIN_FLOOR")
    assert "<svg" in (tmp_path / "residual.svg").read_text() and (tmp_path / "better.toml").exists()


NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
SITE_PAGES = {path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").glob("*.md")}
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
    pages = SITE_PAGES | MADE | {path.relative_to(reference.parent).as_posix() for path in reference.rglob("*.md")}
    assert compare_navigation(pages) == []
    assert compare_navigation(pages | {"docs/new.md"}) == ["docs/new.md: not in docs/site/navigation.toml"]
    assert compare_navigation(pages - {"docs/bus.md"}) == [
        "docs/bus.md: in docs/site/navigation.toml, but there is no such page"]
    assert [part["title"] for part in NAVIGATION] == ["Tutorial", "How-to", "Reference", "Explanation"]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_page_of_a_command_has_what_its_help_has(
        command: str, reference: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main.main([command, "--help"])
    page = (reference / "commands" / f"{command}.md").read_text()
    options = set(re.findall(r"^ +(?:-\w, )?(--[a-z][\w-]+)", capsys.readouterr().out, re.MULTILINE))
    assert {"--help", "--json", "--out"} <= options
    assert {option for option in options if f"`{option}" not in page} == set()


def test_the_reference_has_every_effect_key_and_kind(reference: Path) -> None:
    sections = re.findall(r"^##+ (.*)", (reference / "effects.md").read_text(), re.MULTILINE)
    assert {effect.name for plant in list_plants() for effect in find_plant(plant).list_effects()} == set(sections)
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
    assert pages >= SITE_PAGES | MADE | {"index.md", "search.md",
                                       *(page for part in NAVIGATION for page in part["pages"])}
    index = (site / "searchindex.js").read_text()
    assert '"stribeck"' in index and "Search.setIndex(" in index
    notebook_page = (site / "docs" / f"{NOTEBOOK.stem}.html").read_text()
    assert notebook_page.count('.svg"') == 2 and "truth 50 uA" in notebook_page


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
    message = "".join(cell.printed for cell in cells)
    assert "EXPLAINED null_bias explains the residual" in message
    ratios = [float(value) for value in re.findall(r"([\d.]+) times the noise floor", message)]
    assert len(ratios) == 2 and ratios[0] > 20.0 and 0.8 < ratios[1] < 1.2
    ((value, low, high),) = (map(float, groups) for groups in
                             re.findall(r"null bias ([\d.]+) uA \(([\d.]+) \.\. ([\d.]+)\)", message))
    assert low < 50.0 < high and abs(value - 50.0) < 1.0
    assert sum(str(cell.value).startswith("<svg") for cell in cells) == 2


def test_the_notebook_is_stored_without_results() -> None:
    assert check_format(json.loads(NOTEBOOK.read_text())) == []


PAGE = (ROOT / "docs" / "json.md").read_text()
SCHEMAS = load_schemas()

PROMISED = {  # keys that other programs rely on: of an answer, and below one of its keys
    ("run", ""): "verdict trace checks timing fdi",
    ("compare", ""): "verdict signals solver_error where blocks",
    ("explain", ""): "verdict effects candidates baseline blind_to separate pattern",
    ("add", ""): "model ledger floor",
    ("fdi", ""): "level ruling events precursors grid refined",
    ("run", "timing"): "cycles overruns lateness_us response_us scheduler",
    ("compare", "signals"): "unit error floor ratio closed_loop_error",
    ("compare", "where"): "section t0 t1 share condition",
    ("compare", "blocks"): "controller servovalve jack sensor",
    ("explain", "candidates"): "effect parameters error holdout ratio evidence p_value word",
    ("explain", "baseline"): "error holdout floor",
    ("explain", "blind_to"): "effect smallest_visible unit",
    ("add", "ledger"): "effect error holdout",
    ("fdi", "events"): "band signal t_in t_out",
    ("fdi", "grid"): "step ramp merged",
}


@pytest.mark.parametrize("name", SCHEMAS)
def test_a_schema_is_valid_named_in_the_page_and_refers_to_what_is_there(name: str) -> None:
    Draft202012Validator.check_schema(SCHEMAS[name])
    assert SCHEMAS[name]["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert f"schema/{name}" in PAGE
    for reference in re.findall(r'"\$ref": "([^"]+)"', json.dumps(SCHEMAS[name])):
        file, _, place = reference.partition("#")
        schema: Any = SCHEMAS[file or name]
        for key in place.strip("/").split("/") if place else []:
            schema = schema[key]
        assert schema["type"], reference


def test_every_command_that_answers_in_json_has_a_schema() -> None:
    words = [[command] for command in COMMANDS] + [["bench", "realtime"]]
    more = {"common.json", "evidence_verify.json", "fdi_learn_bands.json", "suite.json", "check_bench.json",
            "check_plant.json"}
    assert {name_schema(each) for each in words} | more == set(SCHEMAS)


@pytest.mark.parametrize(("command", "key"), PROMISED)
def test_the_promised_keys_are_required(command: str, key: str) -> None:
    schema = SCHEMAS[f"{command}.json"]
    if key:
        schema = schema["properties"][key]
        schema = next((each for each in schema.get("anyOf", []) if "properties" in each), schema)
        schema = schema.get("items") or schema.get("additionalProperties") or schema
    assert set(PROMISED[command, key].split()) <= set(schema["required"])


def list_keys(schema: Any) -> Iterator[str]:
    """Every key that a schema describes, at any depth; not the keys of its references."""
    if isinstance(schema, dict):
        properties = schema.get("properties")
        if isinstance(properties, dict) and "type" in schema:
            yield from properties
        for value in schema.values():
            yield from list_keys(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from list_keys(value)


def keys_of(answer: Any) -> set[str]:
    if isinstance(answer, dict):
        return {*answer} | {key for value in answer.values() for key in keys_of(value)}
    return {key for value in answer for key in keys_of(value)} if isinstance(answer, list) else set()


def assert_all_seen(name: str, *answers: Any) -> None:
    """No key of a schema is one that no answer has."""
    for answer in answers:
        check_answer([name], answer)
    assert set(list_keys(SCHEMAS[f"{name}.json"])) <= keys_of(list(answers))


def test_the_answers_of_runs(preflight: Path, aborted: Path) -> None:
    answers = [json.loads((folder / "verdict.json").read_text()) for folder in (preflight, aborted)]
    assert answers[1]["cause"] is not None and answers[1]["nodes"].keys() == {"2", "3"}
    # what these two runs do not have; the tests of real-time runs check it in their answers
    answers[1]["consequences"] = [{"t": 0.0, "source": "node 2 controller", "kind": "stopped", "text": "silent"}]
    answers[1]["fdi"] = {"verdict": "CANNOT_TELL", "sentence": "not judged: too short"}
    answers[1]["judged"]["lateness"] = [{"t": 0.0, "cycle": 1, "last": 1, "source": "rig", "text": "late"}]
    answers[1]["limits"] = [{"parameter": "p", "signal": "xj", "limit": 1.0, "t": 0.0, "seconds": 1.0,
                             "frame": ""}]
    answers[1]["calibration"] = {"xj": {
        "signal": "xj", "unit": "m", "identifier": "K-118", "date": "2026-03-01", "expiry": "2027-03-01", "u": 1e-6,
        "distribution": "normal", "gain": 0.0, "noise": 0.0, "problem": ""}}
    assert_all_seen("run", *answers)


def test_the_answers_of_small_commands(preflight: Path, here: Path) -> None:
    Path("command.csv").write_text("t,com\n0,0\n0.001,1e-3\n0.002,1e-3\n")
    simulation = rig("simulate", "--command", "command.csv", "--out", "short.csv", "--json").json
    samples = rig("simulate", "--samples", "--json").json
    traces = [Path(name) for name in ("run.csv", "run2.csv", "held.csv")]
    assert samples["traces"] == [*map(str, traces)] and all(trace.exists() for trace in traces)
    assert_all_seen("simulate", simulation, samples)
    kinds = ("parameters", "signals", "sequences", "effects", "checks", "models", "benches", "plants", "faults")
    assert_all_seen("list", *(rig("list", kind, "--json").json for kind in kinds))
    assert_all_seen("report", rig("report", preflight, "--out", "page.html", "--json").json)
    assert_all_seen("export", rig("export", preflight, "--out", "run.csv", "--force", "--json").json,
                    rig("export", "--fmu", "eha.fmu", "--json").json)
    assert_all_seen("recover", rig("recover", preflight / "trace.mcap", "--out", "again.mcap", "--json").json)
    check_answer(["import"], rig("import", "run.csv", "--out", "run.mcap", "--json").json)
    check_answer(["check"], rig("check", "preflight", "--json").json)
    assert_all_seen("diff", rig("diff", preflight, "run.csv", "--json").json)
    assert_all_seen("doctor", rig("doctor", "--json").json)


def test_the_answer_of_a_diagnosis(preflight: Path) -> None:
    answer = rig("fdi", preflight, "--json").json
    assert answer["events"] == []
    event = {"band": "most", "fault": "spool_friction", "signal": "speed", "section": "step", "t_in": 0.0,
             "t_out": 0.1, "excess": 1e-3}
    explanation = {"effects": ["null_bias"], "probability": 1.0, "parameters": {}, "ratio": {"xj": 1.0},
                   "level": answer["level"], **{key: answer["refined"][key] for key in ("kintas", "fss")}}
    beside = {"effects": [], "explained": True, "ambiguous": False, "disputed": [], "marks": {},
              "explanations": [explanation]}  # of --with-effects, whose search takes a minute
    assert_all_seen("fdi", answer, {**answer, "events": [event], "with_effects": beside})


def test_the_answer_of_a_comparison(tmp_path: Path) -> None:
    runs = write_measured_runs(tmp_path, HIDDEN)
    assert_all_seen("compare", rig("compare", runs["est"], "--repeat", runs["repeat"], "--json").json)


def test_a_newer_version_may_add_keys() -> None:
    """The published schema accepts what the tests refuse."""
    Draft202012Validator(SCHEMAS["report.json"]).validate({"report": "report.html", "pages": 1})
    assert not build_validator("report.json").is_valid({"report": "report.html", "pages": 1})

"""The JSON answers have schemas: published in docs/schema, complete, and true of what the commands print.

Every test that reads an answer with `rig_command.Said.json` checks it against its schema as well.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from answer_schemas import build_validator, check_answer, load_schemas, name_schema
from jsonschema import Draft202012Validator
from places import ROOT
from rig_command import rig
from short_runs import HIDDEN, write_measured_runs

from rig.cli.command_list import COMMANDS

PAGE = (ROOT / "docs" / "json.md").read_text()
SCHEMAS = load_schemas()

PROMISED = {  # keys that other programs rely on
    "run": "verdict trace checks timing fdi",
    "compare": "verdict signals solver_error where blocks",
    "explain": "verdict effects candidates baseline blind_to separate pattern",
    "add": "model ledger floor",
    "fdi": "level ruling events precursors grid refined",
}
PROMISED_BELOW = {
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
        found: Any = SCHEMAS[file or name]
        for key in place.strip("/").split("/") if place else []:
            found = found[key]
        assert found["type"], reference


def test_every_command_that_answers_in_json_has_a_schema() -> None:
    words = [[command] for command in COMMANDS] + [["bench", "realtime"]]
    more = {"common.json", "evidence_verify.json", "fdi_learn_bands.json", "suite.json", "check_bench.json",
            "check_plant.json"}
    assert {name_schema(each) for each in words} | more == set(SCHEMAS)
    assert name_schema(["bench", "--json"]) == "bench.json"
    assert name_schema(["fdi", "--learn-bands", "a.csv"]) == "fdi_learn_bands.json"


@pytest.mark.parametrize("command", PROMISED)
def test_the_promised_keys_are_required(command: str) -> None:
    schema = SCHEMAS[f"{command}.json"]
    assert set(PROMISED[command].split()) <= set(schema["required"])
    for (owner, key), keys in PROMISED_BELOW.items():
        if owner == command:
            inner = schema["properties"][key]
            inner = next((each for each in inner.get("anyOf", []) if "properties" in each), inner)
            inner = inner.get("items") or inner.get("additionalProperties") or inner
            assert set(keys.split()) <= set(inner["required"]), key


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


def list_explained(schema: Any) -> Iterator[str]:
    """The keys of a schema that have a description, and the words of all descriptions."""
    if isinstance(schema, dict):
        yield from re.findall(r"\w+", schema["description"]) if isinstance(schema.get("description"), str) else ()
        yield from (key for key, value in schema.get("properties", {}).items() if "description" in value)
        for value in schema.values():
            yield from list_explained(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from list_explained(value)


@pytest.mark.parametrize("command", ["run", "diff", "check", "compare", "explain", "add", "identify", "fdi", "trend"])
def test_a_schema_explains_every_key(command: str) -> None:
    schema = SCHEMAS[f"{command}.json"]
    assert set(list_keys(schema)) <= {*list_explained(schema), "verdict", "filter_clogging", "spool_friction"}


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
    answers[1]["limits"] = [{"parameter": "p", "signal": "xj", "limit": 1.0, "t": 0.0, "seconds": 1.0}]
    answers[1]["calibration"] = {"xj": {
        "signal": "xj", "unit": "m", "identifier": "K-118", "date": "2026-03-01", "expiry": "2027-03-01", "u": 1e-6,
        "distribution": "normal", "gain": 0.0, "noise": 0.0, "problem": ""}}
    assert_all_seen("run", *answers)


def test_the_answers_of_small_commands(preflight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("command.csv").write_text("t,com\n0,0\n0.001,1e-3\n0.002,1e-3\n")
    simulated = rig("simulate", "--command", "command.csv", "--out", "short.csv", "--json").json
    samples = rig("simulate", "--samples", "--json").json
    traces = [Path(name) for name in ("run.csv", "run2.csv", "held.csv")]
    assert samples["traces"] == [*map(str, traces)] and all(trace.exists() for trace in traces)
    assert_all_seen("simulate", simulated, samples)
    kinds = ("parameters", "signals", "sequences", "effects", "checks", "models", "benches", "faults")
    assert_all_seen("list", *(rig("list", kind, "--json").json for kind in kinds))
    assert_all_seen("report", rig("report", preflight, "--out", "page.html", "--json").json)
    assert_all_seen("export", rig("export", preflight, "--out", "run.csv", "--force", "--json").json,
                    rig("export", "--fmu", "eha.fmu", "--json").json)
    assert_all_seen("recover", rig("recover", preflight / "trace.mcap", "--out", "again.mcap", "--json").json)
    imported = rig("import", "run.csv", "--out", "run.mcap", "--json").json
    check_answer(["import"], imported)
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


def test_a_key_that_a_schema_lacks_and_one_that_an_answer_lacks_are_found() -> None:
    answer = {"report": "report.html"}
    check_answer(["report"], answer)
    with pytest.raises(AssertionError, match=r"docs/schema/report\.json, the answer: .*'pages' was unexpected"):
        check_answer(["report"], {**answer, "pages": 1})
    with pytest.raises(AssertionError, match="'report' is a required property"):
        check_answer(["report"], {})
    with pytest.raises(AssertionError, match=r"doctor\.json, verdict: 'GOOD' is not one of"):
        check_answer(["doctor"], {"verdict": "GOOD", "findings": []})


def test_a_newer_version_may_add_keys() -> None:
    """The published schema accepts what the tests refuse."""
    Draft202012Validator(SCHEMAS["report.json"]).validate({"report": "report.html", "pages": 1})
    assert not build_validator("report.json").is_valid({"report": "report.html", "pages": 1})

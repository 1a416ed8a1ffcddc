"""`rig list`: every name that a command takes, with unit, range and default; `rig` alone says what to do first."""
from __future__ import annotations

import re

import pytest
from rig_command import rig

from plant import Model, load_model
from plant.effects import CATALOGUE
from rig.cli.commands.list import KINDS
from rig.cli.main import FIRST_STEPS
from rig.sequences import checks, load_sequence


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_a_table_without_cut_words(kind: str) -> None:
    rows = rig("list", kind, "--json").json[kind]
    said = rig("list", kind)
    assert said.status == 0 and "…" not in said.out
    words = set(said.out.split())
    assert rows and all(row["name"] in words for row in rows)


def test_the_parameters_are_those_that_set_takes() -> None:
    rows = {row["name"]: row for row in rig("list", "parameters", "--json").json["parameters"]}
    assert rows.keys() >= Model().values.keys()
    assert rows.keys() >= {name for e in CATALOGUE.values() if e.port and e.file is None for name in e.parameters
                           if name.partition(".")[0] == "null_bias"}
    assert rows["filter.clogging"] == {"name": "filter.clogging", "unit": "1", "default": 0.0, "range": ">= 0, < 1"}
    assert rows["filter.law"]["default"] == "sqrt" and "linear" in rows["filter.law"]["range"]
    for name, row in rows.items():
        if isinstance(row["default"], float):
            load_model().replace({name: row["default"]})  # a default is a value that --set takes
    own = rig("list", "parameters", "jack", "--set", "jack.mass=150", "--json").json["parameters"]
    assert all("jack" in row["name"] for row in own)
    assert next(row["default"] for row in own if row["name"] == "jack.mass") == 150.0


def test_sequences_checks_and_models_can_be_used() -> None:
    assert [row["name"] for row in rig("list", "checks", "--json").json["checks"]] == list(checks.KINDS)
    for row in rig("list", "sequences", "--json").json["sequences"]:
        assert load_sequence(row["name"]).title == row["title"]
    for row in rig("list", "models", "--json").json["models"]:
        assert load_model(row["name"]).plant == row["plant"]


def test_bad_kinds_are_one_line() -> None:
    refused = rig("list", "nonsense")
    assert refused.status == 2 and refused.err.count("\n") == 1 and "parameters" in refused.err
    nothing = rig("list", "signals", "nonsense")
    assert (nothing.status, nothing.out.split(".")[0]) == (0, "no signals of that name")


def test_the_first_steps_are_commands_that_exist() -> None:
    from rig.cli.command_list import COMMANDS

    named = re.findall(r"^    rig (\w+)", FIRST_STEPS, re.MULTILINE)
    alone = rig()
    assert (alone.status, alone.out, alone.err.count("\n")) == (2, FIRST_STEPS + "\n", 1)
    assert len(named) >= 5 and set(named) <= set(COMMANDS)

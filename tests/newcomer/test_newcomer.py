"""The quick parts of what a newcomer does: bad inputs, the lines of the pages, Ctrl-C. `make newcomer` plays all."""

from pathlib import Path

import pytest
from bad_inputs import BAD_INPUTS, BadInput, find_faults, write_bad_files
from interruption import LONG_COMMANDS, find_damage, interrupt_command, judge_end, judge_time
from places import ROOT
from play_newcomer import make_environment
from rig_command import rig
from shown_commands import (
    NEEDS_HARDWARE,
    NOT_PLAYED,
    NOT_PLAYED_PAGES,
    NOT_PLAYED_SECTIONS,
    PARTS,
    Part,
    Step,
    find_section,
    judge_line,
    list_command_lines,
    list_steps,
    play_page,
    play_part,
)

from plant.effects import CATALOGUE
from rig.cli.command_list import COMMANDS


def test_bad_input_gets_one_line_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bad_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    found = {}
    for case in BAD_INPUTS:
        said = rig(*case.words.split())
        CATALOGUE.pop("slip", None)  # of one of them
        found[case.words] = find_faults(case, said.status, said.out, said.err)
    assert {words: faults for words, faults in found.items() if faults} == {}


def test_bad_inputs_are_of_every_command() -> None:
    assert {case.words.split()[0] for case in BAD_INPUTS} == {*COMMANDS, "fly"}
    assert len(BAD_INPUTS) >= 60


def test_a_bad_answer_to_bad_input_is_found() -> None:
    case = BadInput("compare absent.csv", ("absent.csv",))
    assert find_faults(case, 2, "", "rig compare: absent.csv: expected a file\n") == []
    assert find_faults(case, 0, "x", "rig: oh\nno") == [
        "status 0", "prints on standard output", "2 lines of error", "does not name absent.csv"]


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial.md"])
def test_every_line_of_a_page_is_a_step(page: str) -> None:
    """The newcomer plays what the reader sees: no command is left out, and an answer stands below its command."""
    text = (ROOT / page).read_text()
    steps = list_steps(text)
    shown = [line for line in text.splitlines() if line.startswith("    rig ")]
    assert len([step for step in steps if step.text.startswith("rig ")]) == len(shown) > 10
    assert steps[0].kind == "line" and [step for step in steps if step.kind == "answer"]


def test_the_lines_of_a_page_are_played_in_order(tmp_path: Path) -> None:
    page = """
    mkdir here && cd here

    # my_effects.py
    x = 1

    rig list models eha          # a remark
    rig list models eha          # WITHIN_FLOOR is not what it prints
    rig report absent.mcap
    rig conformance 2 --bus socketcan:can0 --eds node2.eds

    WITHIN_FLOOR  That was printed nowhere.
"""
    steps = list_steps(page)
    assert [step.kind for step in steps] == ["line", "file", "line", "line", "answer", "line", "line", "answer"]
    assert steps[1] == Step("file", "# my_effects.py\nx = 1\n", "my_effects.py") and NEEDS_HARDWARE in steps[6].text
    played = list(play_page(page, tmp_path, make_environment()))
    assert [each.status for each in played] == [0, 0, 0, None, 2, 2, None]
    assert [len(each.faults) for each in played] == [0, 0, 0, 1, 1, 0, 1], played
    assert (tmp_path / "here" / "my_effects.py").read_text() == "# my_effects.py\nx = 1\n"


def test_a_line_that_ends_badly_is_found() -> None:
    assert judge_line("rig run", 1, "") == [] and judge_line(f"rig run --bus {NEEDS_HARDWARE}", 2, "one line") == []
    assert judge_line("rig run", 70, "Traceback (most recent call last):") == [
        "status 70: Traceback (most recent call last):", "a traceback"]


def test_ctrl_c_ends_a_search_and_leaves_nothing(tmp_path: Path) -> None:
    """Without figures of time: a test shares the machine; `make newcomer` measures them."""
    assert rig("simulate", "--out", tmp_path / "run.csv").status == 0
    done = interrupt_command("explain", "explain run.csv --out page.html", 1.0, tmp_path, make_environment())
    assert done.status == 130 and not [fault for fault in done.faults if "to the end" not in fault]
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


def test_what_an_interrupted_command_leaves_is_judged(tmp_path: Path) -> None:
    damaged = {"a.json": "{", "a.toml": "x = ", "a.csv": "t,com\n0,", "a.html": "<html>", "a.mcap": "x",
               ".part-1-a.csv": ""}
    whole = {"b.json": "{}", "b.toml": "x = 1", "b.csv": "t,com\n", "b.html": "<html></html>\n", "b.txt": ""}
    for name, text in {**damaged, **whole}.items():
        (tmp_path / name).write_text(text)
    assert {path.name for path in tmp_path.iterdir() if find_damage(path)} == {*damaged}
    assert judge_end(130, "rig fdi: interrupted\n") == [] and len(judge_end(1, "Traceback\nx\n")) == 3
    assert judge_time(0.5, 0.4) == [] and judge_time(0.5, 2.5) and judge_time(1e6, 0.1)
    assert {words.split()[0] for words in LONG_COMMANDS.values()} <= {*COMMANDS}


def test_every_command_line_of_a_page_is_played_or_has_a_reason() -> None:
    """And a reason belongs to a line that stands on a page."""
    played = {page: "".join(find_section(page, part.section) for part in PARTS if part.page == page)
              for page in {part.page for part in PARTS}}
    pages = [f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")) if path.name != "tutorial.md"]
    shown = {page: list_command_lines((ROOT / page).read_text()) for page in pages}
    skipped = {page: [line for where, title in NOT_PLAYED_SECTIONS if where == page
                      for line in list_command_lines(find_section(page, title))] for page in pages}
    missing = [f"{page}: {line}" for page, lines in shown.items() if page not in NOT_PLAYED_PAGES for line in lines
               if line not in [*list_command_lines(played.get(page, "")), *skipped[page]]]
    assert missing == []
    assert {*NOT_PLAYED_PAGES} <= {page for page, lines in shown.items() if lines} - {*played}
    assert {*NOT_PLAYED} <= {line for page in played for line in shown[page]}


def test_a_part_of_a_page_is_played_with_its_files(tmp_path: Path) -> None:
    part = Part("docs/effects.md", "", "echo 1 > there.txt")
    played = list(play_part(part, tmp_path, make_environment() | {"PATH": "/bin:/usr/bin"}))  # without rig
    words = [done.line.split()[1] for done in played if done.status == 127 and done.faults]
    assert words == ["effects", "effects", "simulate", "run", "effects"]
    assert {"there.txt", "my_effects.py"} <= {path.name for path in (tmp_path / "docs_effects_md").iterdir()}


def test_the_page_of_rig_diff_is_played(tmp_path: Path) -> None:
    """One page as it stands; `make newcomer` plays all."""
    played = list(play_part(Part("docs/diff.md"), tmp_path, make_environment()))
    assert [(done.line.split()[1], done.status, done.faults) for done in played] == [
        ("run", 0, ()), ("run", 1, ()), ("diff", 1, ())]

"""What a newcomer types wrongly, Ctrl-C in a search; that `make newcomer` plays all lines of the pages or says why not.
"""

import signal
import time
from pathlib import Path

from bad_inputs import BAD_INPUTS, find_faults, write_bad_files
from places import ROOT
from rig_command import finished, rig, started
from shown_commands import (
    NOT_PLAYED,
    NOT_PLAYED_PAGES,
    NOT_PLAYED_SECTIONS,
    PARTS,
    find_section,
    list_command_lines,
)

from plant.effects import CATALOGUE
from rig.cli.command_list import COMMANDS


def test_bad_input_gets_one_line_that_names_it(here: Path) -> None:
    write_bad_files(here)
    before = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    case_faults = {}
    for case in BAD_INPUTS:
        result = rig(*case.words.split())
        CATALOGUE.pop("slip", None)  # of one of them
        case_faults[case.words] = find_faults(case, result.status, result.out, result.err)
    assert {words: faults for words, faults in case_faults.items() if faults} == {}
    assert {path: path.read_bytes() for path in here.rglob("*") if path.is_file()} == before


def test_bad_inputs_are_of_every_command() -> None:
    assert {case.words.split()[0] for case in BAD_INPUTS} == {*COMMANDS, "fly"}


def test_ctrl_c_ends_a_search_and_leaves_nothing(tmp_path: Path) -> None:
    assert rig("simulate", "--out", tmp_path / "run.csv").status == 0
    process = started("explain", tmp_path / "run.csv", "--out", tmp_path / "page.html")
    time.sleep(3.0)  # it may still load its libraries, and then it ends as well
    process.send_signal(signal.SIGINT)
    result = finished(process)
    assert (result.status, result.err.count("\n")) == (130, 1), result
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


def test_every_command_line_of_a_page_is_played_or_has_a_reason() -> None:
    """And a reason belongs to a line that stands on a page."""
    played_text = {page: "".join(find_section(page, part.section) for part in PARTS if part.page == page)
                   for page in {part.page for part in PARTS}}
    pages = [f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")) if path.name != "tutorial.md"]
    page_lines = {page: list_command_lines((ROOT / page).read_text()) for page in pages}
    skipped_lines = {page: [line for where, title in NOT_PLAYED_SECTIONS if where == page
                            for line in list_command_lines(find_section(page, title))] for page in pages}
    missing = [f"{page}: {line}" for page, lines in page_lines.items() if page not in NOT_PLAYED_PAGES for line in lines
               if line not in [*list_command_lines(played_text.get(page, "")), *skipped_lines[page]]]
    assert missing == []
    assert {*NOT_PLAYED_PAGES} <= {page for page, lines in page_lines.items() if lines} - {*played_text}
    assert {*NOT_PLAYED} <= {line for page in played_text for line in page_lines[page]}

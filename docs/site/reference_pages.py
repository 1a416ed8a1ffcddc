"""The reference pages of the site, which are made from the code."""
from __future__ import annotations

from pathlib import Path

from catalogue_pages import write_effect_page, write_parameter_page
from command_pages import write_command_list, write_command_page
from conformance_page import write_conformance_page
from json_page import write_json_page
from python_page import write_python_page
from sequence_page import write_sequence_page

from rig.cli.command_list import COMMANDS


def write_reference(folder: Path) -> None:
    """Write all reference pages into a folder."""
    (folder / "commands").mkdir(parents=True)
    pages = {"json": write_json_page(), "sequences": write_sequence_page(), "effects": write_effect_page(),
             "parameters": write_parameter_page(), "conformance": write_conformance_page(),
             "python": write_python_page(), "commands": write_command_list(),
             **{f"commands/{name}": write_command_page(name) for name in COMMANDS}}
    for name, lines in pages.items():
        (folder / f"{name}.md").write_text("\n".join(lines) + "\n")

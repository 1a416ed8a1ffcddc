"""Settings of Sphinx for the site of the project; build_site.py uses them."""
from __future__ import annotations

import ast
import re
import tomllib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx

project = "eha-rig"
html_title = "eha-rig"
root_doc = "index"
extensions = ["myst_parser"]
myst_heading_anchors = 4
highlight_language = "none"
html_theme = "pydata_sphinx_theme"
html_static_path = ["style"]
html_css_files = ["site.css"]
smartquotes = False  # -- stands for itself
html_show_sourcelink = False
html_copy_source = False
html_use_index = False
html_sidebars = {"index": []}
html_theme_options = {
    "navbar_center": ["navbar-nav"],
    "navbar_persistent": ["search-button"],
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": [],
    "footer_end": [],
    "show_toc_level": 2,
    "search_as_you_type": True,
}


def setup(app: Sphinx) -> None:
    """Colour the blocks of code, which the pages indent and do not label."""
    app.connect("doctree-read", name_languages)


def name_languages(app: Sphinx, doctree: nodes.document) -> None:
    """Set the language of each block that has none."""
    from docutils.nodes import literal_block

    for block in doctree.findall(literal_block):
        if block.get("language", highlight_language) == highlight_language:
            block["language"] = find_language(block.astext())


def find_language(code: str) -> str:
    """The language of a block of code: of a file in Python or TOML, of lines for a shell, or none."""
    if re.match(r"(rig|make|pip|sudo|python|pytest|mkdir) \S", code):
        return "sh"
    for language, read in (("toml", tomllib.loads), ("python", ast.parse)):
        try:
            read(code)
        except (ValueError, SyntaxError):
            continue
        if re.search(r"^(\[|\w+ ?=|import |from |def |class |@|\w+[.(])", code, re.MULTILINE):
            return language
    return highlight_language

"""The HTML writer: one page that needs no network, from one template."""
from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from fdi.output import write_text
from fdi.report.report import Item, Medium, Report

if TYPE_CHECKING:
    from jinja2 import Environment


def render_html(report: Report) -> str:
    """The page of a report as text. Everything in the report is escaped but the figures, which are SVG."""
    template = load_templates().get_template("page.html")
    return template.render(report=report, sections=report.select_sections(Medium.PAGE), page=Medium.PAGE)


def write_html(report: Report, path: str | Path, option: str = "--out") -> None:
    """Write the page of a report.

    Raises:
        InputError: a path that cannot be written; it names `option`.
    """
    write_text(path, render_html(report), option)


@cache
def load_templates() -> Environment:
    """The page template of this package with its functions; what is put in is escaped."""
    from jinja2 import Environment, PackageLoader

    templates = Environment(loader=PackageLoader("fdi.report", "."), autoescape=True, trim_blocks=True,
                            lstrip_blocks=True)
    templates.globals["group_by_kind"] = _group_by_kind
    templates.globals["figure_script"] = Path(__file__).with_name("figure.js").read_text(encoding="utf-8")
    return templates


def _group_by_kind(items: Sequence[Item]) -> list[tuple[str, list[Item]]]:
    """Runs of items of the same type, by its name: neighbouring lines share a table."""
    return [(kind.__name__, list(group)) for kind, group in groupby(items, key=type)]

"""Fills the templates of files that the rig writes. A template lies beside the code that fills it."""

from functools import cache
from typing import Any


@cache
def _load_environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # here: it takes a while to load

    return Environment(loader=PackageLoader("rig", "."), trim_blocks=True, lstrip_blocks=True,
                       keep_trailing_newline=True, undefined=StrictUndefined,
                       autoescape=lambda name: name is not None and name.endswith(".xml"))


def fill_template(path: str, /, **values: object) -> str:
    """The text of the template at `path` in this package; in XML the values are escaped."""
    return str(_load_environment().get_template(path).render(values))

"""What is wrong with a built site: links and anchors without a target, and what would be loaded from a network."""
from __future__ import annotations

import re
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"src", "srcset", "poster", "data"}  # attributes whose target the browser loads; href of <link>, too
REMOTE = re.compile(r"(https?:)?//", re.IGNORECASE)


class _Page(HTMLParser):
    """The targets of a page, and its anchors."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the attributes of an element."""
        values = {key: value or "" for key, value in attrs}
        self.anchors |= {values[key] for key in ("id", "name") if key in values}
        self.loaded += [values[key] for key in LOADED & values.keys()]
        if "href" in values:
            is_loaded = tag == "link" and values.get("rel") not in ("canonical", "author", "next", "prev", "search")
            (self.loaded if is_loaded else self.links).append(values["href"])


@cache
def _read_page(path: Path) -> _Page:
    return _Page(path.read_text(encoding="utf-8"))


def find_faults(site: Path) -> list[str]:
    """What is wrong with the site in a folder, one line each."""
    _read_page.cache_clear()
    faults = [] if (site / "index.html").is_file() else [f"{site}: no index.html"]
    for path in sorted(set(site.rglob("*.html")) - set(site.glob("_static/**/*"))):
        page, name = _read_page(path), path.relative_to(site).as_posix()
        faults += [f"{name}: loads {target} from a network" for target in page.loaded if REMOTE.match(target)]
        faults += [f"{name}: {fault}" for target in page.links + page.loaded
                   if (fault := _find_link_fault(path, target))]
    for path in sorted(site.rglob("*.css")):
        text = path.read_text(encoding="utf-8")
        faults += [f"{path.relative_to(site)}: loads {target} from a network"
                   for target in re.findall(r"(?:url\(|@import)\s*['\"]?((?:https?:)?//[^'\")\s]+)", text)]
    return list(dict.fromkeys(faults))


def _find_link_fault(page: Path, target: str) -> str:
    """What is wrong with a link of a page; empty for a good one, and for one that leads out of the site."""
    parts = urlsplit(target)
    if parts.scheme or parts.netloc:
        return ""
    path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
    if not path.is_file():
        return f"{target}: no such file"
    is_page = path.suffix == ".html" and parts.fragment
    return f"{target}: no such anchor" if is_page and unquote(parts.fragment) not in _read_page(path).anchors else ""

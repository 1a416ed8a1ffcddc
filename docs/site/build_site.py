"""Build the documentation as a site that needs no network: python docs/site/build_site.py [FOLDER] (default: site).

The pages of docs/ stay where they are. Copies of them, pages made from the code and the notebooks with their results
become HTML by Sphinx. A page outside the navigation, a link or an anchor without a target, or something that would be
loaded from a network ends this program with status 1.
"""
from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from check_site import find_faults
from notebook_page import run_notebook, write_notebook_page
from reference_pages import write_reference

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
NAVIGATION: list[dict[str, Any]] = tomllib.loads((HERE / "navigation.toml").read_text())["part"]


def main() -> int:
    """Build the site into the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Build the documentation as a site.")
    parser.add_argument("out", nargs="?", type=Path, default=ROOT / "site", metavar="FOLDER")
    out: Path = parser.parse_args().out
    faults = build_site(out, {path: run_notebook(path) for path in sorted((ROOT / "docs").glob("*.ipynb"))})
    print("\n".join(faults) or f"{out / 'index.html'}: {sum(1 for _ in out.rglob('*.html'))} pages")
    return min(len(faults), 1)


def build_site(out: Path, notebooks: Mapping[Path, Any]) -> list[str]:
    """Build the site into a folder, which is emptied before. `notebooks`: file to cells with their results.

    Returns:
        what is wrong with it, one line each.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder)
        write_source(source, notebooks)
        known = {path.relative_to(source).as_posix() for path in source.rglob("*.md")} - {"index.md"}
        faults = compare_navigation(known)
        write_navigation(source)
        shutil.rmtree(out, ignore_errors=True)
        if run_sphinx(source, out):
            faults.append("Sphinx reports warnings or errors")
    return faults + find_faults(out)


def write_source(source: Path, notebooks: Mapping[Path, Any]) -> None:
    """Write all pages except those of the navigation."""
    shutil.copytree(ROOT / "docs", source / "docs", ignore=shutil.ignore_patterns("site", "*.py", "__pycache__"))
    for path, cells in notebooks.items():
        write_notebook_page(path, cells, source / "docs" / f"{path.stem}.md")
    readmes = [path.relative_to(ROOT) for name in ("examples", "studies") for path in (ROOT / name).rglob("README.md")]
    for name in ("ARCHITECTURE.md", "CHANGELOG.md", *readmes):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    shutil.copy(ROOT / "README.md", source / "index.md")
    write_reference(source / "reference")
    for page in source.rglob("*.md"):
        copy_linked_files(page, source)


def copy_linked_files(page: Path, source: Path) -> None:
    """Copy the files of the project that a page links to and that are no pages."""
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        path = (page.parent / target).resolve()
        if "://" in target or path.exists() or not path.is_relative_to(source.resolve()):
            continue
        original = ROOT / path.relative_to(source.resolve())
        if original.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(original, path)


def compare_navigation(known: set[str]) -> list[str]:
    """Pages that the navigation lacks, names twice or names in vain; pages below a page of reference/ are its own."""
    listed = [page for part in NAVIGATION for page in part["pages"]]
    own = {page for page in known if page.startswith("reference/") and page.count("/") > 1}
    return ([f"{page}: not in docs/site/navigation.toml" for page in sorted(known - own - {*listed})]
            + [f"{page}: in docs/site/navigation.toml, but there is no such page"
               for page in sorted({*listed} - known)]
            + [f"{page}: twice in docs/site/navigation.toml"
               for page in sorted({page for page in listed if listed.count(page) > 1})])


def write_navigation(source: Path) -> None:
    """Write one page for each part, and the first page, which is the README."""
    for part in NAVIGATION:
        lines = [f"# {part['title']}", "", part["text"], "", "| page | content |", "|---|---|"]
        lines += [f"| [{read_title(source / page)}]({page}) | {text} |" for page, text in part["pages"].items()]
        lines += list_contents(page.removesuffix(".md") for page in part["pages"])
        (source / f"{part['name']}.md").write_text("\n".join(lines) + "\n")
    with (source / "index.md").open("a") as index:
        index.write("\n" + "\n".join(list_contents(part["name"] for part in NAVIGATION)) + "\n")


def list_contents(names: Any) -> list[str]:
    """A table of contents that Sphinx reads and does not show."""
    return ["", "```{toctree}", ":hidden:", "", *names, "```"]


def read_title(page: Path) -> str:
    """The title of a page."""
    return next((line[2:] for line in page.read_text().splitlines() if line.startswith("# ")), page.stem)


def run_sphinx(source: Path, out: Path) -> int:
    """Build the HTML; 0 if there was no warning."""
    from sphinx.cmd.build import build_main

    with tempfile.TemporaryDirectory() as cache:
        strict = ["-q", "-W", "--keep-going"]
        return build_main(["-b", "html", *strict, "-c", str(HERE), "-d", cache, str(source), str(out)])


if __name__ == "__main__":
    sys.exit(main())

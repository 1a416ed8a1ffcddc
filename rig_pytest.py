"""The pytest plugin: the fixture `rig_bench` and its options.

pytest imports this file in every project of an environment in which eha-rig is installed. It stands outside the
packages and imports none of them before a test uses the fixture: importing them selects the kernels of linear algebra
of the whole process (`plant.blas`), which a project that does not use the fixture has not asked for.
"""
from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rig.testing.bench import Bench

_BENCH: pytest.StashKey[Bench] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --rig-model and --rig-out."""
    group = parser.getgroup("eha-rig")
    group.addoption("--rig-model", metavar="FILE|NAME", default=None,
                    help="model of the runs of rig_bench that choose none themselves")
    group.addoption("--rig-out", metavar="DIR", default=None,
                    help="folder that keeps the logs and pages of all runs of rig_bench, one folder for each test "
                         "(default: the temporary folder of the test)")


@pytest.fixture
def rig_bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    """A bench with a controller and a simulated actuator: `rig_bench.run("preflight").assert_passed()`."""
    from rig.testing.bench import Bench

    out = request.config.getoption("--rig-out")
    name = re.sub(r"[^\w.=+-]+", "-", request.node.nodeid).strip("-")
    folder = Path(out).absolute() / name if out else tmp_path / "rig"
    bench = Bench(folder, request.config.getoption("--rig-model"))
    request.node.stash[_BENCH] = bench
    yield bench
    properties = request.node.user_properties  # pytest writes them to its JUnit file
    for run in bench.runs:
        properties.append(("rig_run", f"{run.verdict} {run.folder}"))
        for check in run.checks.values():
            properties += [("requirement", f"{requirement} {check.verdict} {check.name}")
                           for requirement in check.requirements]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add a section about its runs to the report of a test that failed."""
    report = yield
    bench = item.stash.get(_BENCH, None)
    if bench is not None and report.when == "call" and report.failed:
        lines = [f"{run.folder}: {run.verdict}{': ' if run.why else ''}{run.why}" for run in bench.runs]
        report.sections.append(("runs of rig_bench", "\n".join(lines)))
    return report

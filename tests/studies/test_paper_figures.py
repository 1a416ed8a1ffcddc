"""The paper's figures are drawn from whatever traces and grids there are, as SVG for a page."""

import xml.etree.ElementTree as ElementTree
from functools import cache

from fdi import Trace
from plant import Model, simulate
from rig.sequences import load_sequence
from studies import paper_figures as figures

PREFLIGHT = load_sequence("preflight").main_profile().command


@cache
def trace(kintas: float, fss: float) -> Trace:
    model = Model().replace({"filter.clogging": kintas, "spool.static_friction": fss,
                             "spool.dynamic_friction": fss / 1.5})
    return Trace.from_columns(simulate(model, PREFLIGHT)._asdict(), 1e-3, {})


def texts(svg: str) -> set[str]:
    """What is written in a drawing; it must be one."""
    root = ElementTree.fromstring(svg)
    assert root.tag.endswith("svg")
    return {element.text or "" for element in root.iter() if element.tag.endswith("text")}


def test_either_fault_alone() -> None:
    runs = {"healthy": trace(0.0, 5.0), "Kintas 0.35": trace(0.35, 5.0), "FSS 70 N": trace(0.0, 70.0)}
    for draw in (figures.draw_steps, figures.draw_ramps):
        assert set(runs) <= texts(draw(runs))
    assert "error [um]" in texts(figures.draw_ramps(runs, number=1))

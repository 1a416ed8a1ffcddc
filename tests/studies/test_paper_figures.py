"""The paper's figures are drawn from whatever traces and grids there are, as SVG for a page."""

import xml.etree.ElementTree as ElementTree
from functools import cache

from fdi import Trace
from fdi.diagnosis.bands import find_excursions
from fdi.diagnosis.make_bands import choose_bands
from fdi.diagnosis.rms_grid import search_grid
from fdi.report.diagnosis_report import draw_maps
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


def test_a_trace_in_its_bands() -> None:
    faulty = trace(0.4, 45.0)
    bands = choose_bands(faulty.com, faulty.load, 1e-3, None, lambda *_: None)
    found, shown, _ = find_excursions(faulty.com, faulty.xj, 1e-3, bands, faulty.sections())
    for kind, signal, first in (("step", "position", "step of +5 mm at 0.5 s"),
                                ("ramp", "position", "ramp of +1 mm at 4.001 s"),
                                ("ramp", "speed", "ramp of -1 mm at 6.501 s")):
        said = texts(figures.draw_bands(found, shown, bands, faulty, kind, signal))
        assert {"measured", "MidBand", "MaxBand", "outside", first} <= said
    assert figures.draw_bands(found, shown, bands, faulty, "step", "speed") == ""


def test_the_maps() -> None:
    grid = search_grid(trace(0.25, 30.0), sliding=(2.0 / 3.0,))
    said = texts(draw_maps(grid, truth=(0.25, 30.0)))
    assert {"A", "B", "C", "G", "injected", "between cells", "Kintas", "FSS [N]"} <= said
    assert any(text.startswith("step sections: ") for text in said)
    assert "injected" not in texts(draw_maps(grid))

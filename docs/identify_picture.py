"""Make the figure identify.svg: python docs/identify_picture.py (needs gcc)."""
from __future__ import annotations

from pathlib import Path

from fdi import identify
from fdi.report.drawing import shorten_svg
from fdi.report.identify_report import draw_estimates
from studies.identification import simulate_unit


def main() -> None:
    """Identify one of the actuators of the trials and draw its parameters."""
    unit = simulate_unit(7)
    found = identify(unit.fitted, holdouts=[unit.held_out])
    print(found)
    drawing = draw_estimates(found.identification.estimates)
    Path(__file__).with_name("identify.svg").write_text(shorten_svg(drawing), encoding="utf-8")


if __name__ == "__main__":
    main()

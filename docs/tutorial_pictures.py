"""Make the figures of the tutorial from the runs in a folder: python docs/tutorial_pictures.py FOLDER."""
from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from fdi import Trace
from fdi.comparison.compare import compare
from fdi.discovery import explain
from fdi.discovery.residual_pattern import find_pattern
from fdi.discovery.runs import read_runs
from fdi.discovery.update_model import load_model_file
from fdi.estimation import compute_residuals, prepare_trace, replay_current
from fdi.report import GREEN, explain_report
from fdi.report.drawing import AFTER, BEFORE, STYLE, shorten_svg, to_svg
from plant import Model
from plant.effects import load_effects

BLOCK = 36  # rows per point of a figure, which has no more pixels
HERE = Path(__file__).parent / "tutorial"
SIGNALS = (("xj", "XJ [um]", 1e6), ("p12", "P12 [bar]", 1e-5), ("xs", "XS [um]", 1e6))


def draw_residuals(run: str, repeat: str, model: Model) -> str:
    """Residuals of each signal of a run with the nominal model and with `model`, replayed as rig compare does."""
    trace = Trace.read(run)
    floor = compare(trace, model, [Trace.read(repeat)]).signals
    with rc_context(STYLE):
        figure = Figure(figsize=(8, 4.5), layout="constrained")
        axes = figure.subplots(3, 1, sharex=True)
        models = ((Model(), BEFORE, "nominal model"), (model, AFTER, "after rig add"))
        for which, colour, label in models:
            prepared = prepare_trace(trace, which)
            rest = compute_residuals(prepared, replay_current(prepared, which))
            whole = len(prepared) // BLOCK * BLOCK
            t = np.arange(0, whole, BLOCK) * trace.period
            for ax, (name, title, scale) in zip(axes, SIGNALS, strict=True):
                blocks = scale * rest[name][:whole].reshape(-1, BLOCK)
                ax.fill_between(t, blocks.min(1), blocks.max(1), color=colour, lw=0.4, label=label)
                ax.set_ylabel(title)
        for ax, (name, _, scale) in zip(axes, SIGNALS, strict=True):
            for side in (-2, 2):
                ax.axhline(side * floor[name].floor.value * scale, color=GREEN, lw=0.8, ls=":")
        axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, borderaxespad=0.0)
        axes[-1].set_xlabel("time [s]; dotted: twice the floor")
        return to_svg(figure, run)


def show_progress(stage: str, share: float) -> None:
    """Replace the line of progress on standard error."""
    print(f"\r{100 * share:3.0f} % {stage:60.60}", end="", file=sys.stderr, flush=True)


def main(folder: str) -> None:
    """Draw residuals and ledger of both examples, and the residual pattern of the second."""
    os.chdir(folder)
    runs = read_runs(Model(), "cog.csv", ["cog2.csv"], "cogheld.csv")
    found = explain(runs.model, runs.est, runs.repeats, runs.holdout, show_progress)
    shape = explain_report.draw_pattern(find_pattern(found.search, found.ledger[-1]), runs.est.t)
    (HERE / "shape.svg").write_text(shorten_svg(shape), encoding="utf-8")
    load_effects(Path("found.py"))
    for example, run, repeat, file in (("first", "run.csv", "run2.csv", "better.toml"),
                                       ("second", "cog.csv", "cog2.csv", "cogged.toml")):
        show_progress(f"figures of the {example} example", 1.0)
        model, known = load_model_file(Path(file))
        (HERE / f"{example}_left.svg").write_text(shorten_svg(draw_residuals(run, repeat, model)), encoding="utf-8")
        drawn = explain_report.draw_ledger(known.ledger, known.floor or {}, model.kind.signals)
        (HERE / f"{example}_ledger.svg").write_text(shorten_svg(drawn), encoding="utf-8")
    print(file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1])

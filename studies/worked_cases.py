"""Make the figures and tables of worked_cases.md: python -m studies.worked_cases (six runs, one minute)."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from fdi import Trace
from fdi.diagnosis.bands import find_excursions
from fdi.diagnosis.make_bands import choose_bands
from fdi.diagnosis.rms_grid import search_grid
from fdi.report.diagnosis_report import draw_maps
from fdi.report.drawing import shorten_svg
from plant import Model, simulate
from studies import paper_figures as figures
from studies.command import start_parser

HERE = Path(__file__).parent.parent / "docs" / "worked_cases"
RIG = [sys.executable, "-m", "rig.cli.main"]
FSS_NC = 5.0  # N
CASES = {"14": (0.25, 6 * FSS_NC), "15": (0.17, 9 * FSS_NC)}
SCATTERED = 40  # units in the table of tolerances
TOLERANCE = 0.015


def run_preflight(folder: str, kintas: float = 0.0, fss: float = FSS_NC, seed: int = 1) -> Trace:
    """Run a preflight check with faults from the first cycle on; FDS stays in proportion to FSS."""
    out = Path(folder, f"{kintas:g}_{fss:g}_{seed}")
    faults = {"filter.clogging": kintas, "spool.static_friction": fss, "spool.dynamic_friction": fss / 1.5}
    settings = [word for name, value in faults.items() for word in ("--set", f"{name}={value!r}")]
    subprocess.run([*RIG, "run", "preflight", "--quiet", "--seed", str(seed), *settings, "--out", str(out)])
    return Trace.read(out)


def format_minima(name: str, drive: str, trace: Trace) -> str:
    """Minima of the three maps and centre of gravity as a row of the table."""
    g = search_grid(trace, drive=drive)
    assert g.step and g.ramp
    cells = [f"{p.sizes[0]:.3f}, {p.sizes[1]:.1f} N ({p.rms * 1e6:.1f} um)" for p in (
        g.step.minimum, g.ramp.minimum, g.joint.minimum, g.best)]
    return f"| {name} | {drive} | {' | '.join(cells)} | {g.merged.sizes[0]:.3f}, {g.merged.sizes[1]:.1f} N | " \
           f"{g.merged.weight:.2f} |"


def format_scatter(kintas: float, fss: float, command: np.ndarray) -> str:
    """Mean and standard deviation of the errors under 1.5 % scatter of every base parameter, as a row of the table."""
    nominal, sizes = Model(), []
    tolerances = [name for name in nominal.list_names() if nominal.kind.parameters[name.split(".")[0]].__name__ not in (
        "Controller", "Sensors") and name not in ("filter.clogging", "filter.law") and "friction" not in name]
    for seed in range(SCATTERED):
        rng = np.random.default_rng(seed)
        unit = nominal.replace({name: nominal[name] * (1 + TOLERANCE * rng.standard_normal()) for name in tolerances})
        unit = unit.replace({"filter.clogging": kintas, "spool.static_friction": fss,
                             "spool.dynamic_friction": fss / 1.5})
        g = search_grid(Trace.from_columns(simulate(unit, command, seed=seed)._asdict(), 1e-3, {}))
        sizes.append([*g.merged.sizes, *g.joint.minimum.sizes, *g.best.sizes])
    errors = np.array(sizes) - [kintas, fss, kintas, fss, kintas, fss]
    mean, sd = errors.mean(0), errors.std(0, ddof=1)
    cells = [f"{mean[i]:+.3f} ± {sd[i]:.3f}, {mean[i + 1]:+.1f} ± {sd[i + 1]:.1f} N" for i in (0, 2, 4)]
    return f"| {kintas:g}, {fss:g} N | {' | '.join(cells)} |"


def main() -> None:
    """Make six runs, draw eight figures, print two tables."""

    def save(number: str, text: str) -> None:
        (HERE / f"fig{number}.svg").write_text(shorten_svg(text), encoding="utf-8")

    with tempfile.TemporaryDirectory() as folder:
        healthy = run_preflight(folder)
        clogged = {f"Kintas {k:g}": run_preflight(folder, kintas=k) for k in (0.25, 0.35)}
        stiff = {f"FSS {f:g} N": run_preflight(folder, fss=f) for f in (35.0, 70.0)}
        cases = {number: run_preflight(folder, *faults) for number, faults in CASES.items()}
        again = run_preflight(folder, seed=2)
    save("7", figures.draw_steps({"healthy": healthy} | clogged))
    save("8", figures.draw_ramps({"healthy": healthy} | stiff))
    case = cases["14"]
    bands = choose_bands(case.com, case.load, case.period, None, lambda *_: None)
    excursions, frictions, _ = find_excursions(case.com, case.xj, case.period, bands, case.sections())
    for number, kind, signal in (("10", "step", "position"), ("11", "ramp", "position"), ("12", "ramp", "speed")):
        save(number, figures.draw_bands(excursions, frictions, bands, case, kind, signal))
    for number, trace in cases.items():
        save(number, draw_maps(search_grid(trace), CASES[number]))
        for drive in ("current", "command"):
            print(format_minima(f"{CASES[number][0]:g}, {CASES[number][1]:g} N", drive, trace))
    for drive in ("current", "command"):
        print(format_minima("healthy", drive, again))
    for faults in (*CASES.values(), (0.0, FSS_NC), (0.35, FSS_NC), (0.0, 70.0)):
        print(format_scatter(*faults, healthy.com))


if __name__ == "__main__":
    start_parser("studies.worked_cases", __doc__).parse_args()
    main()

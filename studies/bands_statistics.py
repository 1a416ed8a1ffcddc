"""Print the tables of the bands in docs/statistics.md, from units that the bands have not seen."""

import math

import numpy as np

from fdi.diagnosis.bands import UnitKind, format_precursor, judge_position, load_default_bands, simulate_units
from fdi.diagnosis.faults import FAULTS, Level
from fdi.trace.sections import find_sections
from plant import load_model
from rig.sequences import load_sequence

NAN, LOW = math.nan, 10 / 3  # N, healthy dynamic friction
UNITS = (("healthy", UnitKind("healthy"), 1008, 2026), ("healthy, others", UnitKind("healthy"), 416, 99),
         *((f"Kintas {k:.3g}", UnitKind("", k), 208, 77) for k in (0.1, 0.15, 0.2, 0.225, 0.25, 0.3, 0.35)),
         *((f"FSS {f} N", UnitKind("", NAN, f), 208, 77) for f in (20, 28, 30, 32, 35, 70)),
         *((f"FSS {f} N, FDS 3.3 N", UnitKind("", NAN, f, LOW / f), 208, 77) for f in (35, 70)),
         *((f"Kintas {k}, FSS {f} N", UnitKind("", k, f), 208, 77) for k, f in ((0.25, 30), (0.17, 45), (0.3, 70))))


def main() -> None:
    """Print the table of band verdicts and the table of precursors."""
    com = load_sequence("preflight").main_profile().command
    parts, bands, model = find_sections(com), load_default_bands(), load_model()
    for name, kind, count, seed in UNITS:
        x = simulate_units(model, com, np.zeros_like(com), kind, count, seed)
        found = [judge_position(com, row, 1e-3, bands, parts=parts) for row in x]
        shares = [100 * np.mean([j.levels.get(f.name, Level.ACCEPTABLE) >= level for j in found])
                  for f in FAULTS for level in (Level.MAINTENANCE, Level.NON_NOMINAL)]
        print(f"| {name} | {count} |", " | ".join(f"{share:.1f} %" for share in shares), "|", flush=True)
    for name, known in bands.precursors.items():
        cells = [format_precursor(known[key], name) for key in ("healthy", "noise")]
        for fault in FAULTS:
            cells += [format_precursor(known[fault.name], name), f"{known[fault.name] / known['noise']:+.1f}"]
        print("|", " | ".join([name, *cells]), "|")


if __name__ == "__main__":
    main()

"""Print the tables of the bands in docs/statistics.md, from units that the bands have not seen."""

import numpy as np

from fdi.diagnosis.bands import judge_position, load_default_bands
from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Level
from fdi.diagnosis.make_bands import simulate_units
from fdi.diagnosis.precursors import format_precursor
from fdi.trace import find_sections
from plant import load_model
from rig.sequences import load_sequence

LOW = {"spool.dynamic_friction": 10 / 3}  # N, of a healthy unit
UNITS = (("healthy", {}, 1008, 2026), ("healthy, others", {}, 416, 99),
         *((f"Kintas {k:.3g}", CLOGGING.list_changes(k), 208, 77) for k in (0.1, 0.15, 0.2, 0.225, 0.25, 0.3, 0.35)),
         *((f"FSS {f} N", FRICTION.list_changes(f), 208, 77) for f in (20, 28, 30, 32, 35, 70)),
         *((f"FSS {f} N, FDS 3.3 N", FRICTION.list_changes(f) | LOW, 208, 77) for f in (35, 70)),
         *((f"Kintas {k}, FSS {f} N", CLOGGING.list_changes(k) | FRICTION.list_changes(f), 208, 77)
           for k, f in ((0.25, 30), (0.17, 45), (0.3, 70))))


def main() -> None:
    """Print the table of band verdicts and the table of precursors."""
    com = load_sequence("preflight").build_main_profile().command
    parts, bands, model = find_sections(com), load_default_bands(), load_model()
    for name, changes, count, seed in UNITS:
        x = simulate_units(model, com, np.zeros_like(com), changes, count, seed)
        judgements = [judge_position(com, row, 1e-3, bands, parts=parts) for row in x]
        shares = [100 * np.mean([j.levels.get(f.name, Level.ACCEPTABLE) >= level for j in judgements])
                  for f in FAULTS for level in (Level.MAINTENANCE, Level.NON_NOMINAL)]
        print(f"| {name} | {count} |", " | ".join(f"{share:.1f} %" for share in shares), "|", flush=True)
    for name, numbers in bands.precursors.items():
        cells = [format_precursor(numbers[key], name) for key in ("healthy", "noise")]
        for fault in FAULTS:
            cells += [format_precursor(numbers[fault.name], name), f"{numbers[fault.name] / numbers['noise']:+.1f}"]
        print("|", " | ".join([name, *cells]), "|")


if __name__ == "__main__":
    main()

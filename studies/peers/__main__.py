"""Peers: the speed of many runs at once and of the RMS grid beside C, jax and NASA ProgPy, in one process."""

from collections.abc import Sequence

from fdi.report import Column, Item, Line, Report, Section, Table
from rig.sequences import load_sequence
from studies.command import report_progress, run_study_command
from studies.peers.grid_runs import compare_grid_runs
from studies.peers.many_runs import compare_many_runs
from studies.peers.rivals import Rival


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and show; see --help."""
    return run_study_command("studies.peers", __doc__, arguments, lambda parser: None, lambda args: (measure(), True))


def measure() -> Report:
    """Race both tasks over the preflight command."""
    command = load_sequence("preflight").build_main_profile().command
    many, grid = compare_many_runs(command, report_progress), compare_grid_runs(command, report_progress)
    return Report(
        command="peers", title="peers", sentence="Speed beside other libraries at the same task.",
        sections=[Section("Many runs at once", tabulate_rivals(many, "many runs at once", "steps/s", "XJ")),
                  Section("RMS grid", tabulate_rivals(grid, "RMS grid, 21 x 21 cells", "cycles/s", "RMS"))],
        data={"many": [rival._asdict() for rival in many], "grid": [rival._asdict() for rival in grid]})


def tabulate_rivals(rivals: Sequence[Rival], title: str, speed_unit: str, compared: str) -> list[Item]:
    """The table of a race, and a line for each rival with a note."""
    columns = [Column(title), Column("speed", f"million {speed_unit}", "right"), Column("ours / theirs", align="right"),
               Column(f"difference of {compared}", align="right")]
    rows = []
    for rival in rivals:
        if rival.speed is not None:
            difference = f"{rival.difference * 1e6:.0e} um" if rival.difference else "none"
            rows.append([rival.name, f"{rival.speed / 1e6:.3g}", f"{rival.ratio:.3g}", difference])
    table = Table(columns, rows, "Speed of other libraries at the same task; above 1 in `ours / theirs` we are faster.")
    return [table, *(Line(rival.name, rival.note) for rival in rivals if rival.note)]


if __name__ == "__main__":
    raise SystemExit(main())

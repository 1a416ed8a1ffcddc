"""The report of `rig trend --score`: how good the prognosis is on simulated units, growth law by growth law."""
from __future__ import annotations

from fdi.report.report import Column, Line, Report, Section, Table
from rig.studies.prognosis.prognosis_score import LAMBDAS
from rig.studies.prognosis.prognosis_summary import LawScores, Scores, to_json


def build_score_report(scores: Scores) -> Report:
    """Report on the scores; its `data` is the answer of `rig trend --score --json`."""
    marks = " ".join(f"{x:g}".lstrip("0") for x in LAMBDAS)
    titles = ("units", f"alpha-lambda {marks}", "horizon", f"relative accuracy {marks}", "covered, MaxBand",
              "covered, MidBand", "too late", "first trend")
    columns = [Column("true law"), *(Column(title, align="right") for title in titles)]
    caption = (f"At {marks} of the time from onset to MaxBand: share of units whose prediction is within alpha of the "
               "truth, and median relative accuracy. Covered: 95 % intervals that contain the truth; too late: "
               "intervals that begin after it.")
    return Report(
        command="trend", title="score",
        sections=[Section("Scores", [
            Table(columns, [_list_cells(line) for line in scores.lines], caption),
            Line("healthy", f"a trend was reported for {scores.false_trends} of {scores.healthy} healthy units")])],
        data=to_json(scores))


def _list_cells(line: LawScores) -> list[str]:
    return [line.law, str(line.units), _format_values(line.alpha_lambda), f"{line.horizon:.2f}",
            _format_values(line.relative), _format_share(line.held), _format_share(line.held_middle),
            _format_share(line.early), f"{line.latency:.2f}"]


def _format_share(pair: tuple[int, int]) -> str:
    good, of = pair
    return f"{good}/{of} {100 * good / max(of, 1):.0f} %"


def _format_values(values: tuple[float, ...]) -> str:
    return " ".join(f"{x:.2f}" for x in values)

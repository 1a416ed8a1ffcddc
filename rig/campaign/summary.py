"""The statistics of a campaign (false alarms, detection by size, confusion, errors, coverage), and their report."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Fault, Level, classify_size
from fdi.estimation import Share, measure_share
from fdi.report import (
    BLUE,
    COMMAND,
    GREEN,
    INK,
    NO_NUMBER,
    RED,
    Cell,
    Column,
    Item,
    Line,
    Mark,
    Medium,
    Mood,
    Paragraph,
    Report,
    Section,
    Table,
    axes,
    call,
    draw_panels,
    format_digits,
    format_duration,
    instant,
)
from plant import count_nouns
from rig.campaign.batch import BatchProgress, Row
from rig.campaign.judge import CANNOT_TELL, FAILED, HEALTHY, OK, REFUSED, label_plant, restore_faults

Figures = dict[str, Any]  # JSON values
# The paper's second worked case, which no cell of a 21 x 21 grid hits.
OFF_GRID = label_plant({"filter_clogging": 0.17, "spool_friction": 45.0})
CLOSE = {CLOGGING.name: 0.05, FRICTION.name: 0.02}  # largest relative error of an estimate of the off-grid case
LEVELS = [level.word for level in Level]


def judge_rate(name: str, share: Share, least: float = 0.0, most: float = 1.0) -> Figures:
    """A share and whether it is in the required range; None if nothing is required, or too few cases were counted.

    Too few are fewer than 20, or so few that a single wrong case would miss the range. They are enough when the whole
    interval is outside the range. From 0 to 1 nothing is required, and the share is for information.
    """
    is_met = None
    if (least, most) != (0.0, 1.0) and share.of:
        if share.low > most or share.high < least:
            is_met = False
        elif share.of >= max(20, round(1.0 / (most - least))):
            is_met = least <= share.value <= most
    return {"name": name, "share": format_share(share), "least": least, "most": most, "met": is_met}


def format_share(share: Share) -> Figures:
    """A share as JSON values: its value beside its count."""
    return {**share._asdict(), "share": share.value if share.of else None}


def summarise_campaign(rows: Sequence[Row], faults: Sequence[Fault] = FAULTS) -> Figures:
    """All figures as JSON values: simulated plants by tolerance, recorded traces one by one.

    A refused or failed case detects nothing. It counts among the cases, but never as a false alarm. Rows of a judgement
    without fault levels enter the status counts and times alone.
    """
    levelled = [row for row in rows if row["status"] != OK or f"level_{faults[0].name}" in row]
    truth = f"true_{faults[0].key}"
    plant_rows = [row for row in levelled if truth in row]
    tolerances = sorted({row["tolerance"] for row in plant_rows})
    columns = ("label", "status", "ruling", *(f"level_{fault.name}" for fault in faults),
               *(fault.key for fault in faults), "trust")
    return {"cases": len(rows), "status": dict(Counter(row["status"] for row in rows)),
            "seconds": summarise_times(rows),
            "faults": [asdict(fault) for fault in faults],
            "tolerances": [_summarise_tolerance(tolerance, [row for row in plant_rows if row["tolerance"] == tolerance],
                                                faults) for tolerance in tolerances],
            "traces": [{name: row.get(name) for name in columns} for row in levelled if truth not in row],
            "reasons": [{"case": row["label"], "seed": row["seed"], "status": row["status"], "reason": row["reason"]}
                        for row in rows if row["status"] != OK]}


def _summarise_tolerance(tolerance: float, rows: Sequence[Row], faults: Sequence[Fault]) -> Figures:
    """The figures of the simulated plants of one tolerance."""
    false_alarms = [row for row in rows if row["label"] == HEALTHY and is_alarm(row, faults)]
    columns = ("seed", "verdict", *(f"level_{fault.name}" for fault in faults))
    return {"tolerance": tolerance, "cases": len(rows), "rates": count_rates(rows, faults),
            "curves": {fault.name: count_detections(rows, fault) for fault in faults},
            "levels": {fault.name: count_levels(rows, fault, faults) for fault in faults},
            "ruling": count_ruling_faults(rows, faults), "errors": [*measure_errors(rows, faults)],
            "false_alarms": [{key: row.get(key) for key in columns} for row in false_alarms]}


def count_rates(rows: Sequence[Row], faults: Sequence[Fault] = FAULTS) -> list[Figures]:
    """The rates of one tolerance, required ones and those for information, with counts."""
    healthy = [row for row in rows if row["label"] == HEALTHY and row["status"] == OK]
    rates = [judge_rate("healthy: false alarm", count_share(healthy, partial(is_alarm, faults=faults)), most=0.005),
             judge_rate("  event outside a band", count_share(healthy, lambda row: bool(row.get("event_count")))),
             judge_rate("  judged acceptable", count_share(healthy, lambda row: row.get("verdict") == "ACCEPTABLE"))]
    rates += [judge_rate(f"{fault.symbol} at {band} detected", count_share(
        [row for row in select_single_fault(rows, fault) if true_size(row, fault) == size],
        partial(is_detected, fault=fault)), least) for fault in faults for band, least, size in (
            ("MidBand", 0.95, fault.acceptable), ("MaxBand", 0.995, fault.maintenance))]
    beyond = [row.get("ruling") == fault.name for fault in faults for row in select_single_fault(rows, fault)
              if classify_size(fault, true_size(row, fault)) > Level.ACCEPTABLE]
    rates.append(judge_rate("ruling fault, MidBand on", measure_share(sum(beyond), len(beyond)), 0.97))
    # The coverage over all plants that scatter, without those at a bound, where an interval starts at the truth.
    errors = list(measure_errors([row for row in rows if row["tolerance"] > 0.0], faults))
    for fault in faults:
        covered = [error["covered"] for error in errors
                   if error["fault"] == fault.name and error["truth"] != fault.range[0]]
        share = measure_share(sum(each["good"] for each in covered), sum(each["of"] for each in covered))
        rates.append(judge_rate(f"{fault.symbol} covered, all", share))
    worked = [row for row in rows if row["label"] == OFF_GRID] if tuple(faults) == FAULTS else []
    return [*rates, *_count_off_grid_rates(worked)]


def _count_off_grid_rates(rows: Sequence[Row]) -> Iterator[Figures]:
    """Without scatter the estimates have to be close; with scatter their intervals have to be right."""
    for error in measure_errors(rows, FAULTS):
        name, is_exact = error["symbol"], rows[0]["tolerance"] == 0.0
        close, covered = (measure_share(error[key]["good"], error[key]["of"]) for key in ("close", "covered"))
        yield judge_rate(f"off-grid {name} within {100 * CLOSE[error['fault']]:g} %", close,
                         least=0.95 if is_exact else 0.0)
        yield judge_rate(f"off-grid {name} covered", covered, *((0.0, 1.0) if is_exact else (0.93, 0.97)))


def count_share(rows: Iterable[Row], is_good: Callable[[Row], bool]) -> Share:
    """The share of good rows."""
    judgements = [bool(is_good(row)) for row in rows]  # a row may have numbers of numpy
    return measure_share(sum(judgements), len(judgements))


def is_alarm(row: Row, faults: Sequence[Fault] = FAULTS) -> bool:
    """Whether the judgement reports a fault beyond acceptable, or something other than the faults."""
    return (any(is_detected(row, fault) for fault in faults)
            or row.get("verdict") in ("AMBIGUOUS", "SOMETHING_ELSE"))


def is_detected(row: Row, fault: Fault, level: Level = Level.MAINTENANCE, judged_by: str = "level") -> bool:
    """Whether the judgement reports the fault at a level or beyond.

    `judged_by` is "level" for the judgement from the sizes, "band" for the one from the bands alone.
    """
    return row["status"] == OK and row.get(f"{judged_by}_{fault.name}") in LEVELS[level:]


def select_single_fault(rows: Iterable[Row], fault: Fault) -> list[Row]:
    """The rows of plants with this fault and no other."""
    return [row for row in rows if row["faults"] == 1 and row["label"].startswith(f"{fault.name}=")]


def true_size(row: Row, fault: Fault) -> float:
    """The true size of a fault, SI."""
    return float(row[f"true_{fault.key}"])


def count_detections(rows: Sequence[Row], fault: Fault) -> list[Figures]:
    """The detection curve: how often a single fault is detected, by size; the first point is the healthy plant.

    detected: level beyond acceptable; most: non-nominal; ruling: named as the ruling fault; bands: beyond acceptable by
    the bands alone.
    """
    healthy = [row for row in rows if row["label"] == HEALTHY and row["status"] == OK]
    groups = {find_usual_size(healthy, fault): healthy} if healthy else {}
    for row in select_single_fault(rows, fault):
        groups.setdefault(true_size(row, fault), []).append(row)
    criteria: dict[str, Callable[[Row], bool]] = {
        "detected": partial(is_detected, fault=fault),
        "most": partial(is_detected, fault=fault, level=Level.NON_NOMINAL),
        "ruling": lambda row: row.get("ruling") == fault.name,
        "bands": partial(is_detected, fault=fault, judged_by="band")}
    in_bands = {size: [row for row in rows if f"band_{fault.name}" in row] for size, rows in groups.items()}
    return [{"size": size, **{name: format_share(count_share((in_bands if name == "bands" else groups)[size], is_good))
                              for name, is_good in criteria.items()}} for size in sorted(groups)]


def find_usual_size(rows: Sequence[Row], fault: Fault) -> float:
    """The median of the true sizes of a fault, SI: those of a parameter with a tolerance differ from unit to unit."""
    return float(np.median([true_size(row, fault) for row in rows]))


def count_levels(rows: Iterable[Row], fault: Fault, faults: Sequence[Fault] = FAULTS) -> dict[str, dict[str, int]]:
    """True level to reported level to number of plants; plants with further faults do not count."""
    answers = [*LEVELS, CANNOT_TELL, REFUSED, FAILED]
    table = {level: dict.fromkeys(answers, 0) for level in LEVELS}
    for row in rows:
        if not has_other_fault(row, faults):
            answer = row[f"level_{fault.name}"] if row["status"] == OK else row["status"]
            table[classify_size(fault, true_size(row, fault)).word][answer] += 1
    return table


def _list_faults(row: Row) -> list[str]:
    """The names of a plant's faults."""
    return [] if row["label"] == HEALTHY else [part.partition("=")[0] for part in row["label"].split()]


def has_other_fault(row: Row, faults: Sequence[Fault] = FAULTS) -> bool:
    """Whether a plant has another fault than those that were looked for."""
    return not {fault.name for fault in faults} >= set(_list_faults(row))


def count_ruling_faults(rows: Iterable[Row], faults: Sequence[Fault] = FAULTS) -> dict[str, dict[str, int]]:
    """What a plant has (a fault and its true level, or several faults) to the reported ruling fault, counts."""
    table: dict[str, Counter[str]] = {}
    for row in rows:
        answer = row.get("ruling") or "none" if row["status"] == OK else row["status"]
        table.setdefault(_describe_faults(row, faults), Counter())[answer] += 1
    return {name: dict(table[name]) for name in sorted(table)}


def _describe_faults(row: Row, faults: Sequence[Fault]) -> str:
    names = _list_faults(row)
    for fault in (fault for fault in faults if names == [fault.name]):
        return f"{names[0]}, {classify_size(fault, true_size(row, fault)).word}"
    return " and ".join(names) or HEALTHY


def measure_errors(rows: Sequence[Row], faults: Sequence[Fault] = FAULTS) -> Iterator[Figures]:
    """Errors of the estimates by label and fault: healthy plants, single faults, both faults, each by size."""
    first, *others = faults
    order = {row["label"]: (row["faults"], true_size(row, first) == first.healthy,
                            *(true_size(row, fault) for fault in (first, *others)), row["label"]) for row in rows}
    for label in sorted(order, key=lambda label: order[label]):
        group = [row for row in rows
                 if row["label"] == label and row["status"] == OK and not has_other_fault(row, faults)]
        for fault in faults:
            low, high = f"{fault.key}_low", f"{fault.key}_high"
            if estimated := [row for row in group if row.get(low) is not None and np.isfinite(row[high] - row[low])]:
                yield _measure_error(label, estimated, fault)


def _measure_error(label: str, rows: Sequence[Row], fault: Fault) -> Figures:
    """The errors of the estimates of one fault over the cases of a label.

    most: 95 % of the errors are smaller; close: errors as small as required of the off-grid case, None for a healthy
    plant; covered: the 95 % interval contains the truth.
    """
    size = find_usual_size(rows, fault)
    error = np.array([row[fault.key] - true_size(row, fault) for row in rows])
    close = measure_share(int((abs(error) <= CLOSE.get(fault.name, 0.05) * abs(size)).sum()), len(error))
    covered = count_share(rows, lambda row: row[f"{fault.key}_low"] <= true_size(row, fault) <= row[f"{fault.key}_high"]
                          )
    return {"label": label, "fault": fault.name, "symbol": fault.symbol, "truth": size,
            "cases": len(error), "bias": float(error.mean()),
            "rms": float(np.sqrt((error**2).mean())), "most": float(np.quantile(abs(error), 0.95)),
            "close": format_share(close) if size != fault.healthy else None, "covered": format_share(covered)}


def summarise_times(rows: Iterable[Row]) -> dict[str, float]:
    """The time of a judgement, s: median, 95 % quantile and maximum; empty if nothing was judged."""
    seconds = [row["seconds"] for row in rows if "seconds" in row]
    if not seconds:
        return {}
    return {"median": float(np.median(seconds)), "p95": float(np.quantile(seconds, 0.95)), "most": max(seconds)}


def describe_progress(progress: BatchProgress) -> str:
    """How far a campaign is: "120/1400, 2 failed, 35 min left"."""
    failures = f", {progress.failed} failed" if progress.failed else ""
    return f"{progress.done}/{progress.total}{failures}, {format_duration(progress.left)} left"


def build_campaign_report(figures: Mapping[str, Any], title: str = "campaign") -> Report:
    """Report on the figures of `rig.campaign.summary.summarise_campaign`, which are its `data`."""
    faults = restore_faults(figures)
    status = ", ".join(f"{count} {word}" for word, count in figures["status"].items())
    took = figures["seconds"]
    time = [Line("time a case", f"{took['median']:.2f} s (median), {took['p95']:.2f} s (95th percentile), "
                                f"{took['most']:.2f} s (longest)")] if took else []
    return Report(
        command="campaign", title=title,
        sentence=f"{count_nouns(figures['cases'], 'case')}: {status or 'none finished'}.",
        sections=[Section("Time", time), *(_build_tolerance_section(part, faults) for part in figures["tolerances"]),
                  Section("Traces", _tabulate_traces(figures["traces"], faults)),
                  Section("Cases without a result", _list_reasons(figures["reasons"]))],
        data=figures)


def _build_tolerance_section(part: Mapping[str, Any], faults: Sequence[Fault]) -> Section:
    tables = [_tabulate_rates(part["rates"]),
              *(_tabulate_detections(fault, part["curves"][fault.name]) for fault in faults),
              *(_tabulate_counts(f"true {fault.name}", part["levels"][fault.name],
                                 f"Cases by true level of {fault.name} (row) and level reported (column).")
                for fault in faults),
              _tabulate_counts("true faults", part["ruling"], "Cases by true faults (row) and ruling fault reported "
                                                              "(column)."),
              _tabulate_errors(part["errors"], faults)]
    title = f"Plants with {100 * part['tolerance']:g} % scatter: {count_nouns(part['cases'], 'case')}"
    return Section(title, [table for table in tables if table.rows], title_medium=Medium.BOTH)


def _number_columns(*titles: str) -> list[Column]:
    """A column of words and columns of numbers."""
    return [Column(titles[0]), *(Column(title, align="right") for title in titles[1:])]


def show_share(count: Mapping[str, Any]) -> tuple[str, str, str]:
    """A share as count, per cent and 95 % interval.

    >>> show_share({"good": 19, "of": 20, "share": 0.95, "low": 0.7513, "high": 0.9987})
    ('19/20', '95.0 %', '75.1 .. 99.9')
    """
    return ("0/0", NO_NUMBER, NO_NUMBER) if not count["of"] else (
        f"{count['good']}/{count['of']}", f"{100 * count['share']:.1f} %",
        f"{100 * count['low']:.1f} .. {100 * count['high']:.1f}")


def _tabulate_rates(rates: Sequence[Mapping[str, Any]]) -> Table:
    required = [format_requirement(100 * rate["least"], 100 * rate["most"]) for rate in rates]
    rows = [[rate["name"], *show_share(rate["share"]), words, _judge_rate(rate["met"], words)]
            for rate, words in zip(rates, required, strict=True) if rate["share"]["of"]]
    return Table(_number_columns("rate", "count", "share", "95 % interval", "required", "verdict"), rows,
                 "Detection and false-alarm rates beside what is required of them.")


def _judge_rate(is_met: bool | None, required: str) -> Cell:
    if is_met is None:
        return Cell("too few" if required else "", "muted")
    return Cell("met", "good") if is_met else Cell("NOT met", "bad")


def format_requirement(low: float, high: float) -> str:
    """The required range of a share in per cent; "" where nothing is required.

    >>> format_requirement(95.0, 100.0), format_requirement(0.0, 0.5), format_requirement(0.0, 100.0)
    ('>= 95 %', '<= 0.5 %', '')
    """
    if low > 0 and high < 100:
        return f"{low:g} .. {high:g} %"
    if low > 0:
        return f">= {low:g} %"
    return f"<= {high:g} %" if high < 100 else ""


def _tabulate_detections(fault: Fault, points: Sequence[Mapping[str, Any]]) -> Table:
    columns = _number_columns(f"{fault.name}{fault.bracketed_unit}", "cases", "detected [%]", "non-nominal [%]",
                              "ruling [%]", "by bands [%]")
    rows = [[f"{point['size']:g}", str(point["detected"]["of"]),
             *(_show_interval(point[key]) for key in ("detected", "most", "ruling", "bands"))]
            for point in points if len(points) > 1]
    return Table(columns, rows, f"Detected: {fault.name} judged maintenance or worse, by true size, with the 95 % "
                                "interval; then the same for judged non-nominal, named as ruling fault, and detected "
                                "by the bands alone.")


def _show_interval(count: Mapping[str, Any]) -> str:
    """A share and its 95 % interval in per cent, as in 95.0 (75.1 .. 99.9)."""
    _, share, interval = show_share(count)
    return share if share == NO_NUMBER else f"{share.removesuffix(' %')} ({interval})"


def _tabulate_counts(title: str, counts: Mapping[str, Mapping[str, int]], caption: str) -> Table:
    answers = list(dict.fromkeys(word for row in counts.values() for word, count in row.items() if count))
    rows = [[truth, *(str(row.get(word, 0)) for word in answers)] for truth, row in counts.items() if any(row.values())]
    return Table(_number_columns(title, *answers), rows, caption)


def _tabulate_errors(errors: Sequence[Mapping[str, Any]], faults: Sequence[Fault]) -> Table:
    rows = []
    for error in errors:
        plant = error["label"]
        for other in faults:
            plant = plant.replace(f"{other.name}=", f"{other.symbol} ")
        rows.append([plant, error["symbol"], str(error["cases"]),
                     *(f"{error[key]:.2g}" for key in ("bias", "rms", "most")), *show_share(error["covered"])[1:]])
    columns = _number_columns("plant", "estimate", "cases", "bias", "RMS", "p95", "covered", "95 % interval")
    return Table(columns, rows, "Errors of the estimated sizes (SI units); covered: share of 95 % intervals that "
                                "contain the true size.")


def _tabulate_traces(traces: Sequence[Mapping[str, Any]], faults: Sequence[Fault]) -> list[Item]:
    columns = [Column("trace"), *(Column(fault.name) for fault in faults), Column("ruling"),
               *(Column(f"{fault.symbol}{fault.bracketed_unit}", align="right") for fault in faults)]
    rows = [[trace["label"], *(trace[f"level_{fault.name}"] or trace["status"] for fault in faults),
             trace["ruling"] or NO_NUMBER,
             *(format_digits(np.nan if trace[fault.key] is None else trace[fault.key]) for fault in faults)]
            for trace in traces]
    return [Table(columns, rows, "Levels, ruling fault and fault sizes of each recorded trace.")]


def _list_reasons(reasons: Sequence[Mapping[str, Any]], most: int = 10) -> list[Item]:
    moods: dict[str, Mood] = {"failed": "bad", "refused": "doubtful"}
    return [*(Line(reason["status"], f"{reason['case']}, seed {reason['seed']}: {reason['reason']}",
                   moods.get(reason["status"], "")) for reason in reasons[:most]),
            *([Paragraph(f"and {len(reasons) - most} more")] if len(reasons) > most else [])]


LINES = (("detected", "maintenance or worse", BLUE), ("most", "non-nominal", RED), ("ruling", "ruling fault", GREEN),
         ("bands", "maintenance or worse, by the bands alone", COMMAND))


def draw_detection_curves(part: Mapping[str, Any], faults: Sequence[Fault] = FAULTS) -> str:
    """Draw the share of units that are detected, by size of a single fault, with 95 % intervals, as SVG.

    `part` is the element of `summarise_campaign(...)["tolerances"]` for one tolerance.
    """
    panels = [_draw_fault(fault, part["curves"][fault.name]) for fault in faults]
    across = 2 if len(panels) > 1 else 1
    panels += [[]] * (-len(panels) % across)
    rows = [panels[i:i + across] for i in range(0, len(panels), across)]
    for row in rows:
        row[0].append(axes(ylabel="share of units [%]", ylim=(-3, 103)))
    return draw_panels("detection", rows, 3.6 * len(rows), 10.0, common_legend=True, sharey=True)


def _draw_fault(fault: Fault, points: Sequence[Mapping[str, Any]]) -> list[Mark]:
    limits = [fault.place_size(departure) for departure in fault.limits[1:]]
    span = max(abs(size - fault.healthy) for size in [*limits, *(point["size"] for point in points)])
    panel: list[Mark] = []
    for i, (key, label, colour) in enumerate(LINES):
        curve_points = [point for point in points if point[key]["of"]]
        x = [point["size"] + 0.004 * (i - 1.5) * span for point in curve_points]  # beside one another
        y = [100 * point[key]["share"] for point in curve_points]
        ends = [[100 * abs(point[key]["share"] - point[key][end]) for point in curve_points]
                for end in ("low", "high")]
        panel.append(call("errorbar", x, y, ends, color=colour, lw=1.4, marker="o", ms=3.5, elinewidth=0.9, capsize=2,
                          label=label))
    labels = sorted(zip(limits, ("MidBand", "MaxBand"), strict=True))
    for (size, word), side in zip(labels, ("right", "left"), strict=True):  # above the curves, clear of one another
        panel += [instant(size, COMMAND, None, 0.9, "--"),
                  call("text", size, 104, word, color=INK, fontsize=8, va="bottom", ha=side)]
    return [*panel, axes(xlabel=f"{fault.name}, {fault.symbol}{fault.bracketed_unit}")]

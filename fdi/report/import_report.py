"""What `rig import` did with each signal, and what `rig import --guess` takes each column for."""

from dataclasses import asdict
from pathlib import Path

from fdi.report.numbers import choose_unit, format_digits, list_first
from fdi.report.report import Cell, Column, Line, Mood, Report, Section, tabulate
from fdi.trace.importing.conversion import Imported, ImportedSignal
from fdi.trace.importing.formats import Measurement
from fdi.trace.importing.guess import GuessedMap, list_recorded

MOST = 12  # channels that a note names; a recording may have hundreds


def build_import_report(imported: Imported, measurement: Measurement, out: Path) -> Report:
    """Rows and period of the trace; a table of its signals."""
    trace = imported.trace
    signals = trace.declared
    table = tabulate(
        imported.signals, (Column("signal"), lambda s: signals.find(s.name).symbol),
        (Column("source"), lambda s: s.source),
        (Column("unit"), lambda s: s.unit), (Column("rate", "Hz", "right"), lambda s: f"{s.rate:.6g}"),
        (Column("range", align="right"), lambda s: _format_range(s, signals.find(s.name).unit)),
        (Column("gaps", align="right"), lambda s: str(s.gaps or "none")),
        (Column("missing", "rows", "right"), lambda s: str(s.missing or "none")),
        caption="Rate and gaps: in the source. Range and missing: in the trace.")
    lines = [Line(signals.find(s.name).symbol, s.how) for s in imported.signals]
    sentence = (f"{out}: {len(trace)} rows of {1e3 * trace.period:.6g} ms from {measurement.path.name} "
                f"({measurement.format})")
    notes = _list_notes(imported, measurement)
    data = {"trace": str(out), "cycles": len(trace), "period": trace.period, "format": measurement.format,
            "provenance": dict(trace.provenance), "signals": {s.name: asdict(s) for s in imported.signals},
            "sensors": {name: asdict(sensor) for name, sensor in trace.sensors.items()}}
    return Report("import", str(measurement.path), sentence=sentence, data=data, notes=notes,
                  sections=[Section("Signals", [table, *lines])], next_command=f"rig compare {out}")


def build_guess_report(guessed: GuessedMap, measurement: Measurement, out: Path, model: str | None = None) -> Report:
    """Which column is taken for which signal; `model`: of the plant, as the next command names it."""
    moods: dict[str, Mood] = {"sure": "good", "likely": "doubtful", "unsure": "bad"}
    columns = guessed.chosen
    signals = guessed.signals
    missing = [s.symbol for s in list_recorded(signals) if s.name in signals.required and s.name not in columns]
    unused_columns = [f"{name} ({why})" for name, why in guessed.left.items()]
    notes = [*([f"no column was found for {', '.join(missing)}: complete the map by hand"] if missing else []),
             *([f"columns left out: {list_first(unused_columns, MOST)}"] if unused_columns else [])]
    table = tabulate(
        columns, (Column("signal"), lambda name: name if name == "time" else signals.find(name).symbol),
        (Column("source"), lambda name: columns[name][0]),
        (Column("confidence"), lambda name: Cell(columns[name][1], moods[columns[name][1]])),
        caption="The map says why in comments. Check what is not sure.")
    return Report("import", str(measurement.path), notes=notes, sections=[Section("Guess", [table])],
                  sentence=f"{out}: first map of {measurement.path.name} ({measurement.format}); check it",
                  next_command=f"rig import {measurement.path} --map {out}" + (f" --model {model}" if model else ""),
                  data={"map": str(out), "signals": {name: {"source": source, "confidence": confidence}
                                                     for name, (source, confidence) in guessed.chosen.items()}})


def _list_notes(imported: Imported, measurement: Measurement) -> list[str]:
    """Signals that the trace does not have, and columns of the recording that no signal uses."""
    signals, names = imported.trace.declared, {s.name for s in imported.signals}
    unused_columns = [name for name in measurement.units if name not in imported.used]
    return [*(f"no {s.symbol}: {s.quantity} is not judged by itself" for s in signals.outputs if s.name not in names),
            *([f"no {signals.load.symbol}: it is taken as 0; a load that did act is then a force that the model lacks"]
              if signals.load and signals.load.name not in names else []),
            *(f"{signals.find(s.name).symbol} is not held for a row, and its samples are no whole part of a row apart: "
              f"its rows may be off by up to {1e3 / s.rate:.3g} ms, and rig compare may find fault with a healthy unit"
              for s in imported.signals if s.name in signals.required and s.rate * imported.trace.period > 1.05
              and s.how.startswith(("last sample", "low-pass filtered, straight", "straight"))),
            *([f"not in the map, not imported: {list_first(unused_columns, MOST)}"] if unused_columns else [])]


def _format_range(s: ImportedSignal, si: str) -> str:
    scale, unit = choose_unit(si, max(abs(s.low), abs(s.high)))
    size = max(abs(s.low), abs(s.high)) / scale
    return f"{format_digits(s.low / scale, 4, size)} .. {format_digits(s.high / scale, 4, size)} {unit}"

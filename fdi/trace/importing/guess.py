"""A first map of a recording, guessed from names, units and data; each choice with its reasons and how sure it is."""

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from fdi.thresholds import LEAST_QUANTUM_NOISE, LEAST_SCALING_CORRELATION, LEAST_SPEED_CORRELATION
from fdi.trace import Floats, find_comb, hold_last
from fdi.trace.importing.formats import OTHER_UNITS, Channel, Measurement, split_unit
from plant import EHA, UNITS, InputError, Signal, Signals, Unit, find_unit, fit_unit, load_nominal_values, quote_text

# Words of a column's name, in English, German, French, Spanish and Italian, and how much each says for a signal: of a
# role, or of an output with that SI unit. Name and symbol of the signal itself say most.
WORDS: Mapping[str, Sequence[tuple[str, float]]] = {
    "command": (("com|cmd|command|demand|setpoint|set ?point|soll|consigne|consigna|comando|posref|referencia", 3),
                ("ref|reference|target|desired|ziel", 2), ("pos|position|weg|stroke|lage|posicion|posizione", 1)),
    "controlled": (("lvdt|posfb|ist|istwert|actual|measured|feedback|fb", 2),
                   ("pos|position|stroke|displacement|weg|hub|course|deplacement|recorrido|posicion|posizione|corsa|lage",
                    2), ("ram|rod|piston|kolben|jack|cylinder|zylinder|verin|cilindro", 1)),
    "Pa": (("dp|delta ?p|differenzdruck|pl", 3), ("pressure|druck|pression|presion|pressione|press|p", 2),
           ("diff|difference|load|last", 1), ("pa|pb|p1|p2", 2)),
    "m": (("spool|schieber|tiroir|corredera|cursore", 3), ("valve ?pos|ventilweg|ventilhub", 3)),
    "A": (("current|strom|courant|corriente|corrente|ventilstrom", 3), ("i|iv|servo|coil", 1.5),
          ("valve|ventil|vanne|valvula", 0.5)),
    "V": (("voltage|spannung|tension|tensione|volt", 3), ("u|v|motor", 1.5)),
    "N m": (("torque|moment|drehmoment|couple|par|coppia", 3), ("m|t|motor", 1)),
    "rad": (("angle|winkel|angulo|angolo", 3), ("theta|phi", 2)),
    "rad/s": (("speed|velocity|drehzahl|vitesse|velocidad|velocita", 3), ("omega|w|n", 1)),
    "load": (("load|force|kraft|last|effort|fuerza|forza|carga|carico", 3), ("f|fext|extern", 1)),
}
OWN_WORD = 3.0  # points of a signal's own name or symbol
TIME_WORDS = r"t|time|zeit|temps|tiempo|tempo|timestamp|timestamps|seconds|sec|uhrzeit|exp time"
# SI: smallest and largest amplitude that an actuator has; units that are tried, the usual ones first. By SI unit; of a
# length by role, as a valve's is shorter.
RANGES: Mapping[str, tuple[float, float, tuple[str, ...]]] = {
    "command": (5e-4, 1.0, ("mm", "m", "um")), "controlled": (5e-4, 1.0, ("mm", "m", "um")),
    "output": (5e-6, 5e-3, ("um", "mm", "m")), "Pa": (2e5, 6e7, ("bar", "Pa", "MPa", "psi")),
    "A": (5e-4, 0.4, ("mA", "A")), "N": (20.0, 1e6, ("N", "kN")),
}
SAMPLE = 200_000  # values of a column that are looked at


@dataclass
class Guess:
    """What a column is taken for."""

    source: str
    unit: Unit
    points: float = 0.0  # of the name, the unit and the data
    reasons: list[str] = field(default_factory=list)
    sign: int = 1
    minus: str = ""  # a column that is subtracted
    scale: float | None = None  # of raw values, in `unit`: value = sign * (scale * raw + offset); None: unknown, or 1
    offset: float = 0.0
    quantum: float = 0.0  # step of the readings, in `unit`

    def note(self, points: float, reason: str) -> None:
        """Count what speaks for it, or against it."""
        self.points += points
        self.reasons.append(reason)

    @property
    def confidence(self) -> str:
        """In one word."""
        if self.points >= 5.0:
            return "sure"
        return "likely" if self.points >= 3.0 else "unsure"


class Columns(NamedTuple):
    """The columns of a recording."""

    data: Mapping[str, Floats]  # those of numbers: their first values, missing ones held
    units: Mapping[str, str]  # of all: what the file says, "" for nothing

    def has_raw_unit(self, name: str, si: str) -> bool:
        """Whether the recording names a unit that scale and offset must convert to the quantity with this SI unit."""
        unit_name, unit = self.units[name], find_unit(self.units[name])
        return bool(unit_name) and not fit_unit(unit_name, si) and (unit is None or unit_name in OTHER_UNITS)

    def measures(self, name: str, si: str) -> bool:
        """Whether the unit of a column is one of the quantity with this SI unit."""
        return fit_unit(self.units[name], si) is not None


class GuessedMap(NamedTuple):
    """A map as text, and what was chosen."""

    text: str
    chosen: Mapping[str, tuple[str, str]]  # signal (and "time") to column and confidence
    left: Mapping[str, str]  # columns that are no signal: their range, or why they are none
    signals: Signals  # of the plant


def guess_map(measurement: Measurement, signals: Signals = EHA) -> GuessedMap:
    """The map of a recording of a plant with these `signals`, whose columns are not known."""
    all_columns = Columns(_read_numbers(measurement),
                          {name: unit_name or split_unit(name)[1] for name, unit_name in measurement.units.items()})
    time_lines, time_source, time_confidence = _guess_time(measurement, all_columns)
    columns = all_columns._replace(data={name: x for name, x in all_columns.data.items() if name != time_source})
    guesses = _assign(columns, signals)
    _scale_position(guesses, columns, signals)
    _find_signs(guesses, columns, signals)
    _find_steps(guesses, columns, signals)
    choices = {"time": (time_source or "its own times", time_confidence),
               **{name: (guess.source, guess.confidence) for name, guess in guesses.items()}}
    sources = {column for guess in guesses.values() for column in (guess.source, guess.minus)} | {time_source}
    rest = {name: _describe_left(name, columns, guesses, signals) for name in measurement.units if name not in sources}
    lines = [f"# First map of {measurement.path.name} ({measurement.format}), guessed: check every line.",
             f"# Then: rig import {measurement.path.name} --map THIS_FILE", "", *_list_file_lines(measurement),
             *time_lines, "", *(line for signal in signals[1:]
                                for line in _list_signal_lines(signal, signals, guesses.get(signal.name), columns)),
             *(["# Columns that were left out:"] if rest else []),
             *(f"#   {name} ({why})" for name, why in rest.items())]
    return GuessedMap("\n".join(lines) + "\n", choices, rest, signals)


def _read_numbers(measurement: Measurement) -> dict[str, Floats]:
    """The first values of each column of numbers, missing ones held."""
    try:
        channels: dict[str, Channel] = measurement.read(list(measurement.units), ())
    except InputError:  # some column holds texts
        channels = {}
        for name in measurement.units:
            with suppress(InputError):
                channels |= measurement.read([name], ())
    out = {}
    for name, channel in channels.items():
        x = channel.values[:SAMPLE]
        places = np.flatnonzero(~np.isnan(x))
        if len(places) > 1:
            out[name] = hold_last(np.append(x[places[0]], x))[1:]
    return out


def _simplify_name(name: str) -> str:
    """A name in lower case, its accents and unit removed, words separated by blanks."""
    word = re.sub(r"([a-z])([A-Z])", r"\1 \2", split_unit(name)[0]).lower()
    bare = "".join(c for c in unicodedata.normalize("NFD", word) if not unicodedata.combining(c))
    return " " + re.sub(r"[^a-z0-9]+", " ", bare).strip() + " "


def _has_word(name: str, words: str) -> str:
    """The first of the words that a name has, alone or (four letters and more) within another; "" for none."""
    plain = _simplify_name(name)
    for word in words.split("|"):
        pattern = word if len(word.replace(" ?", "")) >= 4 and word[-2:-1] != " " else rf"(?<=[ 0-9]){word}(?=[ 0-9])"
        if match := re.search(pattern, plain):
            return match[0]
    return ""


def _guess_time(measurement: Measurement, columns: Columns) -> tuple[list[str], str | None, str]:
    """The lines of [time], its column and how sure it is."""
    if measurement.has_times:
        return ["# Each channel has times of its own: no [time] needed."], None, "sure"
    guesses = [_rate_time(name, x, columns) for name, x in columns.data.items()]
    best = max((guess for guess in guesses if guess.points), key=lambda guess: guess.points, default=None)
    if best is None:
        texts = (n for n in columns.units if n not in columns.data)
        date = next((n for n in texts if _has_word(n, TIME_WORDS + "|date|datum")), None)
        if date is not None:
            return ["[time]  # likely: no column of numbers is a time; this one's name says so",
                    f"source = {quote_text(date)}", 'unit = "iso"'], date, "likely"
        return ["[time]  # unsure: no column grows from row to row; put in the true rate",
                "rate = 1000.0  # rows a second"], None, "unsure"
    name = best.source
    return [f"[time]  # {best.confidence}: {', '.join(best.reasons)}", f"source = {quote_text(name)}",
            _guess_time_unit(columns.units[name], columns.data[name])], name, best.confidence


def _rate_time(name: str, x: Floats, columns: Columns) -> Guess:
    """How well a column does as the time; no points for one that cannot be."""
    guess, steps = Guess(name, UNITS["s"]), np.diff(x)
    if not (steps > 0).all():
        return guess
    findings = (
        (True, 2.0, "it grows in every row"),
        (np.median(np.abs(steps - np.median(steps))) <= 0.01 * np.median(steps), 1.0, "evenly"),
        (_has_word(name, TIME_WORDS), 2.0, "its name says time"),
        (columns.measures(name, "s"), 2.0, f"its unit is {columns.units[name]}"))
    for holds, points, reason in findings:
        if holds:
            guess.note(points, reason)
    return guess


def _guess_time_unit(unit_name: str, x: Floats) -> str:
    """The line of the time's unit: the header's, or one in which the steps are those of a logger."""
    unit = find_unit(unit_name)
    if unit is not None and unit.si == "s":
        return f'unit = "{unit.name}"  # as the header says'
    step = float(np.median(np.diff(x)))
    name = next((name for name in ("s", "ms", "us", "ns") if 2e-5 <= step * UNITS[name].factor < 0.05), "s")
    rate = 1.0 / (step * float(UNITS[name].factor))
    return f'unit = "{name}"  # unsure: steps of {step:g} would be {rate:g} rows a second'


def _assign(columns: Columns, signals: Signals) -> dict[str, Guess]:
    """Each signal's column: the pair of most points first."""
    candidates = [(signal.name, guess) for column, x in columns.data.items() if float(np.ptp(x)) > 0.0
                  for signal in list_recorded(signals)
                  if (guess := _rate_column(signal, signals, column, columns)) is not None]
    guesses: dict[str, Guess] = {}
    for name, guess in sorted(candidates, key=lambda pair: -pair[1].points):
        if name not in guesses and guess.source not in {g.source for g in guesses.values()}:
            guesses[name] = guess
    _guess_by_motion(guesses, columns, signals)
    for signal in signals.outputs[1:]:
        if signal.unit == "Pa" and signal.name in guesses:
            _pair_chambers(guesses[signal.name], columns.data)
    return {name: guesses[name] for name in signals.names if name in guesses}


def list_recorded(signals: Signals) -> list[Signal]:
    """The signals that a recording may have a column for: in an open loop the command is the drive."""
    return [s for s in signals[1:] if not (signals.is_open_loop and s.role == "command")]


def _list_words(signal: Signal, signals: Signals) -> list[tuple[str, float]]:
    """The words that speak for a signal, each set with its points."""
    by_role = {signals.command: "command", signals.controlled: "controlled", signals.load: "load"}
    unit = find_unit(signal.unit)  # a plant may declare degrees
    first, *others = WORDS.get(by_role.get(signal, unit.si if unit else signal.unit), ()) or ((None, 0.0),)
    own_words = "|".join(dict.fromkeys(
        re.escape(word.strip()) for word in map(_simplify_name, (signal.name, signal.symbol)) if word.strip()))
    return [(own_words, OWN_WORD) if first[0] is None else (f"{own_words}|{first[0]}", first[1]), *others]


def _rate_column(signal: Signal, signals: Signals, column: str, columns: Columns) -> Guess | None:
    """How well a column fits a signal by name, unit and range; None if its name or its unit excludes it."""
    unit_name, si = columns.units[column], signal.unit
    unit = fit_unit(unit_name, si)
    if unit is None and unit_name and not columns.has_raw_unit(column, si):
        return None
    guess = Guess(column, unit or Unit(si, si, Fraction(1)))
    for words, worth in _list_words(signal, signals):
        if word := _has_word(column, words):
            guess.note(worth, f"its name has {word!r}")
    if not guess.points:
        return None
    place = "controlled" if signal == signals.controlled else signal.role
    usual_range = RANGES.get(place if si == "m" else si)
    low, high, units = usual_range or (0.0, math.inf, (si,))
    x = columns.data[column]
    size = float(np.percentile(np.abs(x - np.median(x)), 99))
    likely_units = [u for u in units if usual_range and low <= size * float(UNITS[u].factor) <= high]
    suits = f"no unit given, its range of {size:.3g} suits {' or '.join(likely_units)}"
    findings = (
        (unit is not None, 2.0, f"its unit is {unit_name}"),
        (unit_name, -2.0, f"its unit {unit_name!r} needs scale and offset"),
        (not usual_range, 0.0, "no unit given"),
        (len(likely_units) == 1, 1.0, suits),
        (likely_units, 0.0, suits),
        (True, -1.0, f"no unit given, and its range of {size:.3g} suits none: counts?"))
    guess.note(*next((points, reason) for holds, points, reason in findings if holds))
    if likely_units and not unit_name:
        guess.unit = UNITS[likely_units[0]]
    amplitude = size * float(guess.unit.factor)
    if usual_range and low <= amplitude <= high:
        guess.note(0.5, "its amplitude is plausible")
    elif usual_range and unit is not None:
        guess.note(-1.0, f"its amplitude, {amplitude:.3g} {si}, is unusual")
    return guess


def _pair_chambers(guess: Guess, data: Mapping[str, Floats]) -> None:
    """A pressure from those of two chambers: columns whose names differ by A and B, or by 1 and 2, alone."""
    plain = {column: re.sub(r"[^a-z0-9]", "", _simplify_name(column)) for column in data}
    source = guess.source
    for column, other in plain.items():
        pairs = [(a, b) for a, b in zip(plain[source], other, strict=False) if a != b]
        if len(other) == len(plain[source]) and len(pairs) == 1 and "".join(sorted(pairs[0])) in ("ab", "12"):
            guess.source, guess.minus = (source, column) if pairs[0][0] < pairs[0][1] else (column, source)
            guess.note(min(4.0 - guess.points, 0.0), "two chambers: check that the first one extends the ram")
            return


def _guess_by_motion(guesses: dict[str, Guess], columns: Columns, signals: Signals) -> None:
    """Command and controlled signal where names say nothing: the two free columns that follow each other best.

    The later one is the controlled signal. In an open loop the drive takes the place of the command, and the speed that
    of the controlled signal.
    """
    is_open, controlled = signals.is_open_loop, signals.controlled
    first = signals.drive if is_open else signals.command
    data, sources = columns.data, {guess.source for guess in guesses.values()}
    known_guesses = {s.name: guesses[s.name] for s in (first, controlled) if s.name in guesses}
    firsts, seconds = ([known_guesses[s.name].source] if s.name in known_guesses else
                       [c for c in data if c not in sources and (columns.measures(c, s.unit) or not columns.units[c]
                                                                 or columns.has_raw_unit(c, s.unit))]
                       for s in (first, controlled))
    pairs = [(abs((correlate_speed if is_open else correlate)(data[a], data[b])), a, b)
             for a in firsts for b in seconds if a != b and len(data[a]) == len(data[b])]
    if len(known_guesses) == 2 or not pairs or max(pairs)[0] <= (LEAST_SPEED_CORRELATION if is_open else 0.9):
        return
    r, a, b = max(pairs)
    if not known_guesses and not is_open and measure_lead(data[a], data[b]) < 0:
        a, b = b, a
    for signal, column, other, order in ((first, a, b, "first"), (controlled, b, a, "later")):
        unit = next((guess.unit for guess in known_guesses.values() if guess.unit.si == signal.unit),
                    UNITS["mm"] if signal.unit == "m" else Unit(signal.unit, signal.unit, Fraction(1)))
        guesses.setdefault(signal.name, Guess(column, unit, 1.5, [
            f"no name says so; correlation {r:.3f} {'of drive and speed ' if is_open else ''}with {other}"
            + ("" if known_guesses else f", and it comes {order}")]))


def correlate_speed(drive: Floats, x: Floats) -> float:
    """Correlation of a drive, (n,), and the speed of `x`, (n,), over a hundredth of them: noise hides a shorter one."""
    lag = max(1, len(x) // 100)
    return correlate(np.convolve(drive, np.full(lag, 1.0 / lag), "valid")[:len(x) - lag], x[lag:] - x[:-lag])


def correlate(a: Floats, b: Floats) -> float:
    """Correlation of two columns of one length; 0 if one does not change."""
    n = min(len(a), len(b))
    x, y = a[:n] - a[:n].mean(), b[:n] - b[:n].mean()
    size = math.sqrt(float(np.sum(x * x)) * float(np.sum(y * y)))
    return float(np.sum(x * y)) / size if size > 0.0 else 0.0


def measure_lead(a: Floats, b: Floats) -> float:
    """Above 0 if `a` moves before `b`: how much better b's future fits than its past."""
    n = min(len(a), len(b))
    shift = max(1, min(20, n // 10))
    return abs(correlate(a[:n - shift], b[shift:n])) - abs(correlate(a[shift:n], b[:n - shift]))


def _scale_position(guesses: Mapping[str, Guess], columns: Columns, signals: Signals) -> None:
    """Scale and offset of a position in counts or volts, roughly, from the other position and the drive."""
    command, controlled, drive = signals.command.name, signals.controlled.name, signals.drive.name
    for name, other in ((controlled, command), (command, controlled)):
        if (not {name, other} <= guesses.keys()
                or not columns.has_raw_unit(guesses[name].source, signals.find(name).unit)
                or columns.has_raw_unit(guesses[other].source, signals.find(other).unit)):
            continue
        guess, base = guesses[name], guesses[other]
        raw, x = columns.data[guess.source], columns.data[base.source]
        if len(raw) != len(x) or abs(correlate(raw, x)) < LEAST_SCALING_CORRELATION:
            continue
        cor = columns.data[guesses[drive].source] if drive in guesses else np.zeros(0)
        slope, shift = fit_scale(raw, x, cor if len(cor) == len(x) else np.zeros(len(x)))
        guess.sign, guess.unit, guess.scale = int(np.sign(slope)), base.unit, float(f"{abs(slope):.4g}")
        guess.offset = float(f"{guess.sign * shift:.4g}")
        guess.note(0.0, f"scale and offset are rough, from {base.source}: put in the true ones")


def fit_scale(raw: Floats, x: Floats, cor: Floats) -> tuple[float, float]:
    """Slope and offset of `raw` (n,) to the position `x` (n,) that it follows.

    A position loop makes Cor (n,) of Com - XJ: x = slope * raw + offset + a constant times Cor, where Cor is below its
    limit. Neither a lag nor a command beyond an end stop changes this. Where it gives no sensible slope, the slope is
    the ratio of the standard deviations.
    """
    middle, size = float(raw.mean()), float(raw.std())
    usual = math.copysign(float(x.std()) / size, correlate(raw, x))
    top = float(np.abs(cor).max())
    free = np.abs(cor) < 0.9 * top
    if free.any():
        basis = np.column_stack([(raw - middle) / size, np.ones(len(raw)), cor / top])[free]
        slope, shift = (float(v) for v in np.linalg.lstsq(basis, x[free], rcond=None)[0][:2])
        if 1.0 / 3.0 < slope / size / usual < 3.0:
            return slope / size, shift - slope * middle / size
    return usual, float(x.mean()) - usual * middle


def _find_steps(guesses: Mapping[str, Guess], columns: Columns, signals: Signals) -> None:
    """The step of readings that are whole multiples of it, where its noise counts beside that of the sensor."""
    nominal = load_nominal_values()
    for signal in signals.outputs:
        guess = guesses.get(signal.name)
        if guess is None or guess.minus or (guess.scale is None and columns.has_raw_unit(guess.source, signal.unit)):
            continue
        comb = find_comb(columns.data[guess.source])
        if comb is not None:
            quantum = float(f"{comb.step * (guess.scale or 1.0):.6g}")
            noise = quantum * float(guess.unit.factor) / math.sqrt(12.0)
            if noise >= LEAST_QUANTUM_NOISE * nominal.get(signal.noise, 0.0):
                guess.quantum = quantum


def _find_signs(guesses: Mapping[str, Guess], columns: Columns, signals: Signals) -> None:
    """Signs by what a position loop does: position follows command, and the drive has the sign of their difference."""
    if not {signals.command.name, signals.controlled.name} <= guesses.keys():
        return
    command, controlled = guesses[signals.command.name], guesses[signals.controlled.name]
    com, xj = ((1.0 if guess.scale is None else guess.scale) * columns.data[guess.source] + guess.offset
               for guess in (command, controlled))
    com = command.sign * com
    r = correlate(com, controlled.sign * xj)
    if r < -0.8:
        controlled.sign = -1
        controlled.note(0.0, f"it moves against {command.source} (correlation {r:.2f}): one sign is turned")
    elif r > 0.8:
        controlled.note(0.5, f"it follows {command.source} (correlation {r:.3f})")
    else:
        controlled.note(-1.0, f"it hardly follows {command.source} (correlation {r:.2f}): check it")
    drive = guesses.get(signals.drive.name)
    if drive is not None and len(com) == len(xj):
        error = com * float(command.unit.factor) - controlled.sign * xj * float(controlled.unit.factor)
        r = correlate(columns.data[drive.source], error)
        above, below = signals.command.symbol, signals.controlled.symbol
        if r < -0.3:
            drive.sign = -1
            drive.note(0.0, f"it is negative while {above} is above {below} (correlation {r:.2f}): sign turned")
        elif r > 0.3:
            drive.note(0.5, f"it has the sign of {above} - {below} (correlation {r:.2f})")


def _list_file_lines(measurement: Measurement) -> list[str]:
    layout = measurement.layout
    if layout is None:
        return []
    return ["[file]  # how the text is written", f"separator = {quote_text(layout.separator)}",
            f"decimal = {quote_text(layout.decimal)}",
            *([f"header = {layout.name_line}"] if layout.name_line else []), ""]


def _list_signal_lines(signal: Signal, signals: Signals, guess: Guess | None, columns: Columns) -> list[str]:
    name, quantity = signal.name, f"{signal.symbol}, {signal.quantity}"
    if guess is None:
        if name not in signals.required or signal not in list_recorded(signals):
            return []
        return [f"# [signals.{name}]  # {quantity}: no column found; every analysis needs it", '# source = ""',
                f'# unit = "{signal.unit}"', ""]
    unit = guess.unit.name
    return [f"[signals.{name}]  # {quantity}; {guess.confidence}: {'; '.join(guess.reasons)}",
            f"source = {quote_text(guess.source)}", f'unit = "{unit}"',
            *([f"minus = {quote_text(guess.minus)}"] if guess.minus else []),
            *(["sign = -1"] if guess.sign < 0 else []),
            *([f"scale = {1.0 if guess.scale is None else guess.scale:g}  # {unit} for each "
               f"{columns.units[guess.source]}: put in the true one", f"offset = {guess.offset:g}  # {unit}"]
              if columns.has_raw_unit(guess.source, signal.unit) else []),
            *([f"sensor = {{quantum = {guess.quantum:g}}}  # {unit}: all readings are multiples of this step"]
              if guess.quantum else []), ""]


def _describe_left(column: str, columns: Columns, guesses: Mapping[str, Guess], signals: Signals) -> str:
    """The range of a column that is no signal, or why it is none."""
    if column not in columns.data:
        return "no numbers"
    x = columns.data[column]
    if float(np.ptp(x)) > 0.0:
        return f"{x.min():.4g} .. {x.max():.4g}"
    candidates = [(guess.points, signal.name, signal.symbol) for signal in signals[1:] if signal.name not in guesses
                  and (guess := _rate_column(signal, signals, column, columns)) is not None]
    hint = f"; by its name it would be {max(candidates)[2]}" if candidates else ""
    return f"always {x[0]:.4g}{hint}"

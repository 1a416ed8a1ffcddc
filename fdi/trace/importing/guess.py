"""A first map of a recording, guessed from names, units and data; each choice with its reasons and how sure it is."""
from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.thresholds import LEAST_QUANTUM_NOISE, LEAST_SCALING_CORRELATION
from fdi.trace.importing.formats import Channel, Measurement, TextTable, split_unit
from fdi.trace.importing.import_map import REQUIRED_SIGNALS, SIGNAL_NAMES, UNITS, convert_to_si, find_unit
from fdi.trace.sensor_dynamics import find_comb
from fdi.trace.signals import OUTPUTS, SIGNALS
from plant.errors import InputError
from plant.parameters import load_nominal_values

Floats = NDArray[np.float64]

# Words of a column's name, in English, German, French, Spanish and Italian, and how much each says for a signal.
WORDS: Mapping[str, Sequence[tuple[str, float]]] = {
    "com": (("com|cmd|command|demand|setpoint|set ?point|soll|consigne|consigna|comando|posref|referencia", 3),
            ("ref|reference|target|desired|ziel", 2), ("pos|position|weg|stroke|lage|posicion|posizione", 1)),
    "xj": (("xj|lvdt|posfb|ist|istwert|actual|measured|feedback|fb", 2),
           ("pos|position|stroke|displacement|weg|hub|course|deplacement|recorrido|posicion|posizione|corsa|lage", 2),
           ("ram|rod|piston|kolben|jack|cylinder|zylinder|verin|cilindro", 1)),
    "p12": (("p12|dp|delta ?p|differenzdruck|pl", 3),
            ("pressure|druck|pression|presion|pressione|press|p", 2), ("diff|difference|load|last", 1),
            ("pa|pb|p1|p2", 2)),
    "xs": (("xs|spool|schieber|tiroir|corredera|cursore", 3), ("valve ?pos|ventilweg|ventilhub", 3)),
    "cor": (("cor|current|strom|courant|corriente|corrente|ventilstrom", 3), ("i|iv|servo|coil", 1.5),
            ("valve|ventil|vanne|valvula", 0.5)),
    "load": (("load|force|kraft|last|effort|fuerza|forza|carga|carico", 3), ("f|fext|extern", 1)),
}
TIME_WORDS = r"t|time|zeit|temps|tiempo|tempo|timestamp|timestamps|seconds|sec|uhrzeit|exp time"
COUNTER_WORDS = r"cnt|count|counter|cycle|tick|ticks|zahler|zaehler|compteur|contador|frame|sample|seq"
RANGES = {  # SI: smallest and largest amplitude that an actuator has; units that are tried, the usual ones first
    "com": (5e-4, 1.0, ("mm", "m", "um")), "xj": (5e-4, 1.0, ("mm", "m", "um")), "xs": (5e-6, 5e-3, ("um", "mm", "m")),
    "p12": (2e5, 6e7, ("bar", "Pa", "MPa", "psi")), "cor": (5e-4, 0.4, ("mA", "A")), "load": (20.0, 1e6, ("N", "kN")),
}
SAMPLE = 200_000  # values of a column that are looked at


@dataclass
class Guess:
    """What a column is taken for."""

    source: str
    points: float  # of the name, the unit and the data
    unit: str = ""
    sign: int = 1
    reasons: list[str] = field(default_factory=list)
    minus: str = ""  # a column that is subtracted
    scale: float | None = None  # of raw values, in `unit`: value = sign * (scale * raw + offset); None: unknown, or 1
    offset: float = 0.0
    quantum: float = 0.0  # step of the readings, in `unit`

    @property
    def confidence(self) -> str:
        """In one word."""
        if self.points >= 5.0:
            return "sure"
        return "likely" if self.points >= 3.0 else "unsure"


class GuessedMap(NamedTuple):
    """A map as text, and what was chosen."""

    text: str
    chosen: Mapping[str, tuple[str, str]]  # signal (and "time") to column and confidence
    left: Mapping[str, str]  # columns that are no signal: their range, or why they are none


def guess_map(measurement: Measurement) -> GuessedMap:
    """The map of a recording whose meaning is not known."""
    data = _read_numbers(measurement)
    time_lines, time_source, time_confidence = _guess_time(measurement, data)
    free = {name: x for name, x in data.items() if name != time_source}
    found = _assign(measurement, free)
    _scale_position(found, measurement, free)
    _find_signs(found, free)
    _find_steps(found, measurement, free)
    chosen = {"time": (time_source or "its own times", time_confidence)}
    chosen |= {name: (guess.source, guess.confidence) for name, guess in found.items()}
    lines = [f"# First map of {measurement.path.name} ({measurement.format}), guessed: check every line.",
             f"# Then: rig import {measurement.path.name} --map THIS_FILE", "", *_list_file_lines(measurement),
             *time_lines, ""]
    for name in SIGNAL_NAMES:
        lines += _list_signal_lines(name, found.get(name), measurement)
    used = {column for guess in found.values() for column in (guess.source, guess.minus)} | {time_source}
    left = {name: _describe_left(measurement, name, data, found) for name in measurement.units if name not in used}
    if left:
        lines += ["# Columns that were left out:", *(f"#   {name} ({why})" for name, why in left.items())]
    return GuessedMap("\n".join(lines) + "\n", chosen, left)


def _read_numbers(measurement: Measurement) -> dict[str, Floats]:
    """The first values of each column of numbers, missing ones held."""
    try:
        channels: dict[str, Channel] = measurement.read(list(measurement.units))
    except InputError:  # some column holds texts
        channels = {}
        for name in measurement.units:
            try:
                channels |= measurement.read([name])
            except InputError:
                continue
    out = {}
    for name, channel in channels.items():
        x = channel.values[:SAMPLE]
        there = np.flatnonzero(~np.isnan(x))
        if len(there) > 1:
            last = np.clip(np.searchsorted(there, np.arange(len(x)), side="right") - 1, 0, None)
            out[name] = x[there[last]]
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
        pattern = word if len(word.replace(" ?", "")) >= 4 else rf"(?<=[ 0-9]){word}(?=[ 0-9])"
        found = re.search(pattern, plain)
        if found:
            return found[0]
    return ""


def _guess_time(measurement: Measurement, data: Mapping[str, Floats]) -> tuple[list[str], str | None, str]:
    """The lines of [time], its column and how sure it is."""
    if measurement.has_times:
        return ["# Each channel has times of its own: no [time] needed."], None, "sure"
    best: tuple[float, str, list[str]] | None = None
    for name, x in data.items():
        steps = np.diff(x)
        unit = find_unit(measurement.units[name])
        points, why = 0.0, []
        if (steps > 0).all():
            points, why = 2.0, ["it grows in every row"]
            if float(np.median(np.abs(steps - np.median(steps)))) <= 0.01 * float(np.median(steps)):
                points, why = points + 1.0, [*why, "evenly"]
        elif _find_bits(x):
            points, why = 1.5, ["it counts up and starts again"]
        if points and _has_word(name, TIME_WORDS):
            points, why = points + 2.0, [*why, "its name says time"]
        elif points and _has_word(name, COUNTER_WORDS):
            points, why = points + 0.5, [*why, "its name says counter"]
        if points and unit is not None and unit.si == "s":
            points, why = points + 2.0, [*why, f"its unit is {measurement.units[name]}"]
        if points and (best is None or points > best[0]):
            best = points, name, why
    if best is None:
        date = next((n for n in measurement.units if n not in data and _has_word(n, TIME_WORDS + "|date|datum")), None)
        if date is not None:
            return ["[time]  # likely: no column of numbers is a time; this one's name says so",
                    f"source = {_quote(date)}", 'unit = "iso"'], date, "likely"
        return ["[time]  # unsure: no column grows from row to row; put in the true rate",
                "rate = 1000.0  # rows a second"], None, "unsure"
    points, name, why = best
    confidence = Guess(name, points).confidence
    head = f"[time]  # {confidence}: {', '.join(why)}"
    bits = _find_bits(data[name])
    if bits:
        rate, is_known = _guess_count_rate(measurement.units[name], data[name])
        return [head, f"source = {_quote(name)}", f"bits = {bits}", rate], name, confidence if is_known else "unsure"
    unit_name, reason = _guess_time_unit(measurement.units[name], data[name])
    return [head, f"source = {_quote(name)}", f'unit = "{unit_name}"  # {reason}'], name, confidence


def _find_bits(x: Floats) -> int | None:
    """Bits of a counter that wraps: whole numbers that grow and fall back by nearly a power of two."""
    steps = np.diff(x)
    if (x != np.floor(x)).any() or (x < 0).any() or not (steps < 0).any() or (steps == 0).any():
        return None
    bits = max(1, math.ceil(math.log2(float(x.max()) + 1)))
    usual = float(np.median(steps))
    back = steps[steps < 0] + 2.0**bits
    is_wrap = usual > 0 and bool((np.abs(back - usual) < 0.1 * 2.0**bits).all()) and (steps < 0).mean() < 0.2
    return bits if is_wrap else None


def _guess_count_rate(said: str, x: Floats) -> tuple[str, bool]:
    """The line of a counter's rate, and whether the header gives it."""
    steps = np.diff(x)
    step = float(np.median(steps[steps > 0]))
    unit = find_unit(said)
    if unit is not None and unit.si == "s":
        counts = float(1 / unit.factor)
        line = f"rate = {counts:.15g}  # counts a second, as the header says ({said}): {counts / step:g} rows a second"
        return line, True
    return f"rate = {1000.0 * step:.15g}  # counts a second: put in the true one (rows every 1 ms were assumed)", False


def _guess_time_unit(said: str, x: Floats) -> tuple[str, str]:
    unit = find_unit(said)
    if unit is not None and unit.si == "s":
        name = next(name for name, u in UNITS.items() if u == unit)
        return name, "as the header says"
    step = float(np.median(np.diff(x)))
    for name, low, high in (("s", 2e-5, 0.05), ("ms", 0.05, 50.0), ("us", 50.0, 5e4), ("ns", 5e4, 5e7)):
        if low <= step < high:
            rate = 1.0 / (step * float(UNITS[name].factor))
            return name, f"unsure: steps of {step:g} would be {rate:g} rows a second"
    return "s", f"unsure: steps of {step:g}"


def _assign(measurement: Measurement, data: Mapping[str, Floats]) -> dict[str, Guess]:
    """Each signal's column: the pair of most points first."""
    rated = []
    for column, x in data.items():
        for name in SIGNAL_NAMES if float(np.ptp(x)) > 0.0 else ():
            guess = _rate_column(measurement, name, column, x)
            if guess is not None:
                rated.append((name, guess))
    rated.sort(key=lambda pair: -pair[1].points)
    found: dict[str, Guess] = {}
    for name, guess in rated:
        if name not in found and guess.source not in {g.source for g in found.values()}:
            found[name] = guess
    _guess_by_motion(found, measurement, data)
    _pair_chambers(found, data)
    return {name: found[name] for name in SIGNAL_NAMES if name in found}


def _rate_column(measurement: Measurement, name: str, column: str, x: Floats) -> Guess | None:
    """How well a column fits a signal by name, unit and range; None if its name or its unit excludes it."""
    said = measurement.units[column] or split_unit(column)[1]
    unit = find_unit(said)
    if unit is not None and unit.si != SIGNALS[name].unit:
        return None
    points, reasons = 0.0, []
    for words, worth in WORDS[name]:
        word = _has_word(column, words)
        if word:
            points += worth
            reasons.append(f"its name has {word!r}")
    if not points:
        return None
    low, high, units = RANGES[name]
    size = float(np.percentile(np.abs(x - np.median(x)), 99))
    if unit is not None:
        chosen = next(known for known, u in UNITS.items() if u == unit)
        points += 2.0
        reasons.append(f"its unit is {said}")
    elif said:
        chosen = SIGNALS[name].unit
        reasons.append(f"its unit {said!r} needs scale and offset")
        points -= 2.0
    else:
        fitting = [u for u in units if low <= float(convert_to_si(np.array([size]), UNITS[u])[0]) <= high]
        chosen = fitting[0] if fitting else SIGNALS[name].unit
        if fitting:
            reasons.append(f"no unit given, its range of {size:.3g} suits {' or '.join(fitting)}")
            points += 1.0 if len(fitting) == 1 else 0.0
        else:
            reasons.append(f"no unit given, and its range of {size:.3g} suits none: counts?")
            points -= 1.0
    if unit is not None or _is_plausible(name, size, chosen):
        amplitude = float(convert_to_si(np.array([size]), UNITS[chosen])[0])
        if low <= amplitude <= high:
            reasons.append("its range is plausible")
            points += 0.5
        else:
            reasons.append(f"its range, {amplitude:.3g} {SIGNALS[name].unit}, is unusual")
            points -= 1.0
    return Guess(column, points, chosen, 1, reasons)


def _is_plausible(name: str, size: float, unit: str) -> bool:
    """Whether an amplitude in a unit is one that the signal of an actuator has."""
    low, high, _ = RANGES[name]
    return low <= float(convert_to_si(np.array([size]), UNITS[unit])[0]) <= high


def _pair_chambers(found: Mapping[str, Guess], data: Mapping[str, Floats]) -> None:
    """P12 from the pressures of two chambers: columns whose names differ by A and B, or by 1 and 2, alone."""
    guess = found.get("p12")
    if guess is None:
        return
    for first, second in (("a", "b"), ("1", "2")):
        mine = re.sub(r"[^a-z0-9]", "", _simplify_name(guess.source))
        for column in data:
            other = re.sub(r"[^a-z0-9]", "", _simplify_name(column))
            places = [i for i, (x, y) in enumerate(zip(mine, other, strict=False)) if x != y]
            if len(mine) == len(other) and len(places) == 1 and {mine[places[0]], other[places[0]]} == {first, second}:
                source, minus = (guess.source, column) if mine[places[0]] == first else (column, guess.source)
                guess.source, guess.minus, guess.points = source, minus, min(guess.points, 4.0)
                guess.reasons.append("two chambers: check that the first one extends the ram")
                return


def _guess_by_motion(found: dict[str, Guess], measurement: Measurement, data: Mapping[str, Floats]) -> None:
    """Com and XJ where names say nothing: the two free columns that follow each other best; the later one is XJ."""
    for known, wanted in (("com", "xj"), ("xj", "com")):
        if known in found and wanted not in found:
            base = data[found[known].source]
            _take_partner(found, wanted, base, _list_free(found, measurement, data, wanted), data)
    if "com" in found or "xj" in found:
        return
    free = _list_free(found, measurement, data, "xj")
    pairs = [(abs(correlate(data[a], data[b])), a, b) for i, a in enumerate(free) for b in free[i + 1:]]
    if pairs and max(pairs)[0] > 0.9:
        r, a, b = max(pairs)
        first, later = (a, b) if measure_lead(data[a], data[b]) >= 0 else (b, a)
        why = f"no name says so; correlation {r:.3f} of the two, and it comes "
        found["com"] = Guess(first, 1.5, "mm", 1, [why + "first"])
        found["xj"] = Guess(later, 1.5, "mm", 1, [why + "later"])


def _list_free(found: Mapping[str, Guess], measurement: Measurement, data: Mapping[str, Floats], name: str
               ) -> list[str]:
    """Columns that are no signal yet and whose unit does not exclude this one."""
    taken = {guess.source for guess in found.values()}
    units = {column: find_unit(measurement.units[column]) for column in data}
    return [column for column, unit in units.items()
            if column not in taken and (unit is None or unit.si == SIGNALS[name].unit)]


def _take_partner(found: dict[str, Guess], wanted: str, base: Floats, free: Sequence[str], data: Mapping[str, Floats]
                  ) -> None:
    rated = [(abs(correlate(base, data[column])), column) for column in free if len(data[column]) == len(base)]
    if rated and max(rated)[0] > 0.9:
        r, column = max(rated)
        other = "com" if wanted == "xj" else "xj"
        found[wanted] = Guess(column, 2.0, found[other].unit, 1,
                              [f"no name says so; correlation {r:.3f} with {found[other].source}"])


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


def _has_raw_unit(measurement: Measurement, guess: Guess) -> bool:
    """Whether the recording names a unit that scale and offset must convert."""
    said = measurement.units[guess.source] or split_unit(guess.source)[1]
    return bool(said) and find_unit(said) is None


def _scale_position(found: Mapping[str, Guess], measurement: Measurement, data: Mapping[str, Floats]) -> None:
    """Scale and offset of a position in counts or volts, roughly, from the other position and Cor."""
    for name, other in (("xj", "com"), ("com", "xj")):
        if not {name, other} <= found.keys() or not _has_raw_unit(measurement, found[name]):
            continue
        if _has_raw_unit(measurement, found[other]):
            return
        guess, base = found[name], found[other]
        raw, x = data[guess.source], data[base.source]
        r = correlate(raw, x) if len(raw) == len(x) else 0.0
        if abs(r) < LEAST_SCALING_CORRELATION:
            continue
        cor = data[found["cor"].source] if "cor" in found else np.zeros(0)
        slope, shift = fit_scale(raw, x, cor if len(cor) == len(x) else np.zeros(len(x)))
        guess.sign, guess.unit, guess.scale = int(np.sign(slope)), base.unit, float(f"{abs(slope):.4g}")
        guess.offset = float(f"{guess.sign * shift:.4g}")
        guess.reasons.append(f"scale and offset are rough, from {base.source}: put in the true ones")


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


def _find_steps(found: Mapping[str, Guess], measurement: Measurement, data: Mapping[str, Floats]) -> None:
    """The step of readings that are whole multiples of it, where its noise counts beside that of the sensor."""
    nominal = load_nominal_values()
    for name in OUTPUTS:
        guess = found.get(name)
        if guess is None or guess.minus or (guess.scale is None and _has_raw_unit(measurement, guess)):
            continue
        comb = find_comb(data[guess.source])
        if comb is None:
            continue
        quantum = float(f"{comb.step * (guess.scale or 1.0):.6g}")
        noise = float(convert_to_si(np.array([quantum]), UNITS[guess.unit])[0]) / math.sqrt(12.0)
        if noise >= LEAST_QUANTUM_NOISE * nominal[SIGNALS[name].noise]:
            guess.quantum = quantum


def _scale_column(guess: Guess, data: Mapping[str, Floats]) -> Floats:
    """A column in the unit of its guess; its sign is that of the recording."""
    return data[guess.source] if guess.scale is None else guess.scale * data[guess.source] + guess.offset


def _find_signs(found: Mapping[str, Guess], data: Mapping[str, Floats]) -> None:
    """Signs by what a position loop does: XJ follows Com, and Cor is positive while Com is above XJ."""
    if not {"com", "xj"} <= found.keys():
        return
    com, xj = found["com"].sign * _scale_column(found["com"], data), _scale_column(found["xj"], data)
    r = correlate(com, xj)
    if r < -0.8:
        found["xj"].sign = -1
        found["xj"].reasons.append(f"it moves against {found['com'].source} (correlation {r:.2f}): one sign is turned")
    elif r > 0.8:
        found["xj"].points += 0.5
        found["xj"].reasons.append(f"it follows {found['com'].source} (correlation {r:.3f})")
    else:
        found["xj"].points -= 1.0
        found["xj"].reasons.append(f"it hardly follows {found['com'].source} (correlation {r:.2f}): check it")
    if "cor" in found and len(com) == len(xj):
        scale = [float(UNITS[found[name].unit].factor) for name in ("com", "xj")]
        error = com * scale[0] - found["xj"].sign * xj * scale[1]
        r = correlate(data[found["cor"].source], error)
        if r < -0.3:
            found["cor"].sign = -1
            found["cor"].reasons.append(f"it is negative while Com is above XJ (correlation {r:.2f}): sign turned")
        elif r > 0.3:
            found["cor"].points += 0.5
            found["cor"].reasons.append(f"it has the sign of Com - XJ (correlation {r:.2f})")


def _quote(text: str) -> str:
    """As a TOML string."""
    return json.dumps(text, ensure_ascii=False)


def _list_file_lines(measurement: Measurement) -> list[str]:
    if not isinstance(measurement, TextTable):
        return []
    layout = measurement.layout
    lines = ["[file]  # how the text is written", f"separator = {_quote(layout.separator)}",
             f"decimal = {_quote(layout.decimal)}"]
    return [*lines, *([f"header = {layout.name_line}"] if layout.name_line else []), ""]


def _list_signal_lines(name: str, guess: Guess | None, measurement: Measurement) -> list[str]:
    quantity = f"{SIGNALS[name].symbol}, {SIGNALS[name].quantity}"
    if guess is None:
        if name not in REQUIRED_SIGNALS:
            return []
        return [f"# [signals.{name}]  # {quantity}: no column found; every analysis needs it", '# source = ""',
                f'# unit = "{SIGNALS[name].unit}"', ""]
    lines = [f"[signals.{name}]  # {quantity}; {guess.confidence}: {'; '.join(guess.reasons)}",
             f"source = {_quote(guess.source)}", f'unit = "{guess.unit}"']
    if guess.minus:
        lines.append(f"minus = {_quote(guess.minus)}")
    if guess.sign < 0:
        lines.append("sign = -1")
    said = measurement.units[guess.source]
    if guess.scale is not None:
        lines.append(f"scale = {guess.scale:g}  # {guess.unit} for each {said}: put in the true one")
        lines.append(f"offset = {guess.offset:g}  # {guess.unit}")
    elif said and find_unit(said) is None:
        lines.append(f"scale = 1.0  # {guess.unit} for each {said}: put in the true one")
        lines.append(f"offset = 0.0  # {guess.unit}")
    if guess.quantum:
        step = f"sensor = {{quantum = {guess.quantum:g}}}"
        lines.append(f"{step}  # {guess.unit}: all readings are multiples of this step")
    return [*lines, ""]


def _describe_left(measurement: Measurement, column: str, data: Mapping[str, Floats], found: Mapping[str, Guess]
                   ) -> str:
    """The range of a column that is no signal, or why it is none."""
    if column not in data:
        return "no numbers"
    x = data[column]
    if float(np.ptp(x)) > 0.0:
        return f"{x.min():.4g} .. {x.max():.4g}"
    rated = [(guess.points, name) for name in SIGNAL_NAMES if name not in found
             and (guess := _rate_column(measurement, name, column, x)) is not None]
    meant = f"; by its name it would be {SIGNALS[max(rated)[1]].symbol}" if rated else ""
    return f"always {x[0]:.4g}{meant}"

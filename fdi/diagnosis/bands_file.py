"""Bands as a TOML file that a reviewer can read: numbers in um, mm/s and ms, short lists, and their origin."""
from __future__ import annotations

import json
import math
import re
from collections.abc import Container, Iterable, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.bands import STEP_JUDGED_FROM, Bands, RampBand, StepBand, Width
from fdi.output import write_text
from fdi.trace.sections import Section
from plant.errors import InputError
from plant.parameters import parse_toml

Floats = NDArray[np.float64]

DEFAULT = "preflight_bands.toml"
UM_PER_M, MS_PER_S, MM_PER_M = 1e6, 1e3, 1e3
KNOT_CYCLES = 2  # between the times at which shifts and spreads of a step are known
BARE = re.compile(r"[A-Za-z0-9_-]+")  # a key that TOML takes without quotes
LISTS = ("healthy_um", "spread_um", "friction_um", "middle_um", "most_um")
HEADER = """\
# Bands of a command, as `rig fdi --learn-bands` writes them; `rig fdi TRACE --bands FILE` judges by them.
# [[step]]: the mean response of healthy units, a number a cycle from {first:g} ms on; every {coarse} cycles what each
# amount of friction adds, the standard deviation at each, and what Table 2's clogging adds: MidBand stands at
# middle_share of middle_um, MaxBand at most_share of most_um. [[ramp]]: how far following error and speed may be from
# their centre; half the range of the error by friction; slip over it, 1/s, and how much range faster slips cost, s.
# [precursors]: mean and scatter of healthy units; what Kintas 0.25 and FSS 35 N add; SI units and %.
"""


@cache
def load_default_bands() -> Bands:
    """The bands of the preflight command and the nominal plant that come with the software."""
    return parse_bands((files("fdi.diagnosis") / DEFAULT).read_text(encoding="utf-8"), DEFAULT)


def load_bands(path: str | Path) -> Bands:
    """Bands from a file.

    Raises:
        InputError: a file that cannot be read, or that holds no bands.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(path, "--bands", f"a readable file of bands ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(path, "--bands", "a file of bands, as text in UTF-8") from error
    return parse_bands(text, path)


def save_bands(bands: Bands, path: str | Path) -> None:
    """Write bands to a file.

    Raises:
        InputError: a path that cannot be written.
    """
    write_text(path, format_bands(bands))


def format_bands(bands: Bands) -> str:
    """Bands as TOML."""
    lines = [HEADER.format(first=MS_PER_S * STEP_JUDGED_FROM, coarse=KNOT_CYCLES), "[bands]",
             f"period_ms = {bands.period * MS_PER_S:g}", f"friction_N = {_format_list(bands.friction, 2)}",
             f"middle_share = {bands.middle_share:.4f}", f"most_share = {bands.most_share:.4f}", "", "[provenance]",
             *(f"{key} = {json.dumps(value)}" for key, value in bands.provenance.items()), "",
             "# kind, rows from and to, demand before and at the end in um, rate in um/s", "sections = ["]
    for s in bands.sections:
        numbers = _round_values((s.first * UM_PER_M, s.last * UM_PER_M, s.rate * UM_PER_M), 2)
        lines.append(f"  {json.dumps([s.kind, s.start, s.stop, *numbers])},")
    lines.append("]")
    for step in bands.steps:
        knots = slice(None, None, KNOT_CYCLES)
        lines += ["", "[[step]]", f"section = {step.section}",
                  f"healthy_um = {_format_list(step.healthy * UM_PER_M, 1)}",
                  "friction_um = [", *(f"  {_format_list(row[knots] * UM_PER_M, 1)}," for row in step.shift), "]",
                  "spread_um = [", *(f"  {_format_list(row[knots] * UM_PER_M, 2)}," for row in step.spread), "]",
                  f"middle_um = {_format_list(step.middle[knots] * UM_PER_M, 1)}",
                  f"most_um = {_format_list(step.most[knots] * UM_PER_M, 1)}"]
    for ramp in bands.ramps:
        lines += ["", "[[ramp]]", f"section = {ramp.section}",
                  f"position_um = {_format_width(ramp.position, UM_PER_M)}",
                  f"speed_mm_s = {_format_width(ramp.speed, MM_PER_M)}",
                  f"waver_um = {_format_list(ramp.half_range * UM_PER_M, 2)}",
                  f"slip = {ramp.slip:.4g}", f"ease = {ramp.ease:.4g}"]
    lines += ["", "[precursors]"]
    for name, numbers_of in bands.precursors.items():
        pairs = ", ".join(f"{key} = {_format_number(value)}" for key, value in numbers_of.items())
        lines.append(f"{name if BARE.fullmatch(name) else json.dumps(name)} = {{ {pairs} }}")
    return "\n".join(lines) + "\n"


def parse_bands(content: str, where: object) -> Bands:
    """Bands from TOML.

    Raises:
        InputError: text that is not TOML, or lacks a key.
    """
    table = parse_toml(content, where)
    try:
        return _read_bands(table)
    except KeyError as error:
        raise InputError(where, str(error.args[0]), "a file of bands, which has this key") from error
    except (TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        raise InputError(where, "", f"a file of bands as rig fdi --learn-bands writes it ({error})") from error


def _read_bands(table: Mapping[str, Any]) -> Bands:
    head = table["bands"]
    period = float(head["period_ms"]) / MS_PER_S
    provenance = dict(table["provenance"])
    parts = tuple(Section(kind, int(a), int(b), first / UM_PER_M, last / UM_PER_M, rate / UM_PER_M)
                  for kind, a, b, first, last, rate in provenance.pop("sections"))
    friction = np.array(head["friction_N"], float)
    if not (np.diff(friction) > 0.0).all():
        raise ValueError("friction_N: rising values")
    kinds = {kind: [i for i, part in enumerate(parts) if part.kind == kind] for kind in ("step", "ramp")}
    steps = tuple(_read_step(step, period, len(friction), kinds["step"]) for step in table.get("step", ()))
    ramps = tuple(_read_ramp(ramp, len(friction), kinds["ramp"]) for ramp in table.get("ramp", ()))
    return Bands(parts, period, friction, steps, ramps, float(head["middle_share"]), float(head["most_share"]),
                 {key: str(value) for key, value in provenance.items()},
                 {name: {key: float(value) for key, value in numbers.items()}
                  for name, numbers in table.get("precursors", {}).items()})


def _read_step(step: Mapping[str, Any], period: float, amounts: int, parts: Container[int]) -> StepBand:
    healthy, spread, shift, middle, most = (np.array(step[key], float) / UM_PER_M for key in LISTS)
    rows = np.arange(len(healthy))
    coarse = rows[::KNOT_CYCLES]
    if spread.shape != (amounts, len(coarse)) or shift.shape != spread.shape or step["section"] not in parts:
        raise ValueError(f"step of section {step['section']}: not a step of the command, or lists of other lengths")

    def interpolate(values: Floats) -> Floats:
        return np.interp(rows, coarse, values)

    t = (rows + round(STEP_JUDGED_FROM / period)).astype(float)
    return StepBand(int(step["section"]), t * period, healthy,
                    np.array([interpolate(row) for row in shift]),
                    np.array([interpolate(row) for row in spread]), interpolate(middle), interpolate(most))


def _read_ramp(ramp: Mapping[str, Any], amounts: int, parts: Container[int]) -> RampBand:
    half_range = np.array(ramp["waver_um"], float) / UM_PER_M
    if half_range.shape != (amounts,) or ramp["section"] not in parts:
        raise ValueError(f"ramp of section {ramp['section']}: not a ramp of the command, or lists of other lengths")
    position, speed = (Width(*(float(ramp[key][word]) / scale for word in Width._fields))
                       for key, scale in (("position_um", UM_PER_M), ("speed_mm_s", MM_PER_M)))
    return RampBand(int(ramp["section"]), position, speed, half_range, float(ramp["slip"]), float(ramp["ease"]))


def _round_values(values: Iterable[float], places: int) -> list[float]:
    return [round(float(value), places) + 0.0 for value in values]  # no -0.0


def _format_list(values: Iterable[float], places: int) -> str:
    return json.dumps(_round_values(values, places))


def _format_width(width: Width, scale: float) -> str:
    pairs = ", ".join(f"{word} = {_format_number(value * scale)}" for word, value in width._asdict().items())
    return f"{{ {pairs} }}"


def _format_number(value: float) -> str:
    """A number as TOML writes it, NaN and infinity included."""
    return f"{value:.5g}" if math.isfinite(value) else str(value)

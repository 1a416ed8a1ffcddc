"""Bands as a TOML file that a reviewer can read: numbers in um, mm/s and ms, short lists, and where they are from."""
from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Container, Iterable, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.envelope import FIRST, Bands, RampBand, StepBand, Width
from fdi.output import write_text
from fdi.trace.sections import Section
from plant.errors import InputError

Floats = NDArray[np.float64]

DEFAULT = "preflight_bands.toml"
UM, MS = 1e6, 1e3
COARSE = 2  # cycles between the times at which shifts and spreads are written
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
def default() -> Bands:
    """The bands of the preflight command and the nominal plant that come with the software."""
    return parse((files("fdi.diagnosis") / DEFAULT).read_text(encoding="utf-8"), DEFAULT)


def load(path: str | Path) -> Bands:
    """Bands from a file.

    Raises:
        InputError: a file that cannot be read, or is none of bands.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "--bands", "a file of bands that can be read") from error
    return parse(text, path)


def save(bands: Bands, path: str | Path) -> None:
    """Write bands to a file.

    Raises:
        InputError: a path that cannot be written.
    """
    write_text(path, text(bands))


def text(bands: Bands) -> str:
    """Bands as TOML."""
    lines = [HEADER.format(first=1e3 * FIRST, coarse=COARSE), "[bands]", f"period_ms = {bands.period * MS:g}",
             f"friction_N = {_list(bands.friction, 2)}", f"middle_share = {bands.middle_share:.4f}",
             f"most_share = {bands.most_share:.4f}", "", "[provenance]",
             *(f"{key} = {json.dumps(value)}" for key, value in bands.provenance.items()), "",
             "# kind, rows from and to, demand before and at the end in um, rate in um/s", "sections = [",
             *(f"  {json.dumps([s.kind, s.start, s.stop, *_short((s.first * UM, s.last * UM, s.rate * UM), 2)])},"
               for s in bands.sections), "]"]
    for step in bands.steps:
        every = slice(None, None, COARSE)
        lines += ["", "[[step]]", f"section = {step.section}", f"healthy_um = {_list(step.healthy * UM, 1)}",
                  "friction_um = [", *(f"  {_list(row[every] * UM, 1)}," for row in step.shift), "]",
                  "spread_um = [", *(f"  {_list(row[every] * UM, 2)}," for row in step.spread), "]",
                  f"middle_um = {_list(step.middle[every] * UM, 1)}", f"most_um = {_list(step.most[every] * UM, 1)}"]
    for ramp in bands.ramps:
        lines += ["", "[[ramp]]", f"section = {ramp.section}", f"position_um = {_width(ramp.position, UM)}",
                  f"speed_mm_s = {_width(ramp.speed, 1e3)}", f"waver_um = {_list(ramp.waver * UM, 2)}",
                  f"slip = {ramp.slip:.4g}", f"ease = {ramp.ease:.4g}"]
    lines += ["", "[precursors]"]
    for name, numbers in bands.precursors.items():
        pairs = ", ".join(f"{key} = {_toml(value)}" for key, value in numbers.items())
        lines.append(f"{name if BARE.fullmatch(name) else json.dumps(name)} = {{ {pairs} }}")
    return "\n".join(lines) + "\n"


def parse(content: str, where: object) -> Bands:
    """Bands from TOML.

    Raises:
        InputError: text that is no TOML, or misses something.
    """
    try:
        table = tomllib.loads(content)
    except tomllib.TOMLDecodeError as error:
        raise InputError(where, "", f"TOML ({error})") from error
    try:
        return _bands(table)
    except KeyError as error:
        raise InputError(where, str(error.args[0]), "a file of bands, which has this key") from error
    except (TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        raise InputError(where, "", f"a file of bands as rig fdi --learn-bands writes it ({error})") from error


def _bands(table: Mapping[str, Any]) -> Bands:
    head = table["bands"]
    period = float(head["period_ms"]) / MS
    provenance = dict(table["provenance"])
    parts = tuple(Section(kind, int(a), int(b), first / UM, last / UM, rate / UM)
                  for kind, a, b, first, last, rate in provenance.pop("sections"))
    friction = np.array(head["friction_N"], float)
    if not (np.diff(friction) > 0.0).all():
        raise ValueError("friction_N: rising values")
    kinds = {kind: [i for i, part in enumerate(parts) if part.kind == kind] for kind in ("step", "ramp")}
    steps = tuple(_step(step, period, len(friction), kinds["step"]) for step in table.get("step", ()))
    ramps = tuple(_ramp(ramp, len(friction), kinds["ramp"]) for ramp in table.get("ramp", ()))
    return Bands(parts, period, friction, steps, ramps, float(head["middle_share"]), float(head["most_share"]),
                 {key: str(value) for key, value in provenance.items()},
                 {name: {key: float(value) for key, value in numbers.items()}
                  for name, numbers in table.get("precursors", {}).items()})


def _step(step: Mapping[str, Any], period: float, amounts: int, parts: Container[int]) -> StepBand:
    healthy, spread, shift, middle, most = (np.array(step[key], float) / UM for key in LISTS)
    rows = np.arange(len(healthy))
    coarse = rows[::COARSE]
    if spread.shape != (amounts, len(coarse)) or shift.shape != spread.shape or step["section"] not in parts:
        raise ValueError(f"step of section {step['section']}: no step of the command, or lists of other lengths")

    def fine(values: Floats) -> Floats:
        return np.interp(rows, coarse, values)

    t = (rows + round(FIRST / period)).astype(float)
    return StepBand(int(step["section"]), t * period, healthy,
                    np.array([fine(row) for row in shift]), np.array([fine(row) for row in spread]), fine(middle),
                    fine(most))


def _ramp(ramp: Mapping[str, Any], amounts: int, parts: Container[int]) -> RampBand:
    waver = np.array(ramp["waver_um"], float) / UM
    if waver.shape != (amounts,) or ramp["section"] not in parts:
        raise ValueError(f"ramp of section {ramp['section']}: no ramp of the command, or lists of other lengths")
    position, speed = (Width(*(float(ramp[key][word]) / scale for word in Width._fields))
                       for key, scale in (("position_um", UM), ("speed_mm_s", 1e3)))
    return RampBand(int(ramp["section"]), position, speed, waver, float(ramp["slip"]), float(ramp["ease"]))


def _short(values: Iterable[float], places: int) -> list[float]:
    return [round(float(value), places) + 0.0 for value in values]  # no -0.0


def _list(values: Iterable[float], places: int) -> str:
    return json.dumps(_short(values, places))


def _width(width: Width, scale: float) -> str:
    pairs = ", ".join(f"{word} = {_toml(value * scale)}" for word, value in width._asdict().items())
    return f"{{ {pairs} }}"


def _toml(value: float) -> str:
    """A number as TOML has it, also where it is none."""
    return f"{value:.5g}" if math.isfinite(value) else str(value)

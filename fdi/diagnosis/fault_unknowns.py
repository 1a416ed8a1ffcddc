"""The unknowns of a refinement: two faults, what else may be off, and the tolerances, all by their logarithms.

The plant's gains, forces and frictions are scaled; in logarithms what may be scaled together is a straight line.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FRICTION
from fdi.estimation.model_unknowns import free_of
from fdi.estimation.problem import Free, unknowns
from fdi.thresholds import UNIT_TOLERANCE
from plant.effects import CATALOGUE
from plant.model import Model

Floats = NDArray[np.float64]

LEAST, LARGEST = 0.05, 1000.0  # N, friction of the spool
MOST = 0.95  # Kintas
UNKNOWN = 150.0  # 1.5 % each: faults may be of any size; where nothing shows them, this is what is known
SLIDING = 1.5  # FSS over FDS in a start (nominal.toml)


class Suspect(NamedTuple):
    """Something else that ages or is set up wrongly: its parameter, and how far off it is thought possible."""

    effect: str
    parameter: str
    spread: float  # standard deviation known beforehand, as wide as what is typical: SI, or of the logarithm
    ratio: bool = False  # True: of the logarithm


SUSPECTS = (
    Suspect("jack_friction", "jack.dynamic_friction", 0.5, True),
    Suspect("viscous_drag", "jack.damping", 0.7, True),
    Suspect("moving_mass", "jack.mass", 0.5, True),
    Suspect("internal_leakage", "jack.leakage", 2.0, True),
    Suspect("null_bias", "null_bias.current", 1.6e-4),
    Suspect("constant_load", "constant_load.force", 3e3),
)


class Ratio(Free):
    """A parameter by its logarithm: centre, scale and bounds are those of the logarithm."""

    __slots__ = ()

    def value(self, x: float) -> float:
        """SI."""
        return math.exp(super().value(x))


class Over(Ratio):
    """Static friction by its ratio to the dynamic one of the same body, which comes before it."""

    __slots__ = ()


class Open(Free):
    """Kintas by the logarithm of what the filter lets through, 1 - Kintas: gains go with powers of it."""

    __slots__ = ()

    def value(self, x: float) -> float:
        """Kintas."""
        return 1.0 - math.exp(super().value(x))


def values(free: Sequence[Free], x: Floats) -> Floats:
    """Parameters in SI units, (p,), of scaled unknowns (p,)."""
    found = np.array([f.value(float(v)) for f, v in zip(free, x, strict=True)])
    names = [f.name for f in free]
    for k, f in enumerate(free):
        if isinstance(f, Over):
            found[k] *= found[names.index(f.name.replace("static", "dynamic"))]
    i, j = names.index("spool.static_friction"), names.index("spool.dynamic_friction")
    found[j] = min(found[i], found[j])
    return found


def positive(model: Model, name: str) -> float:
    """A parameter of the model as a logarithm can take it: nought is a thousandth of the nominal value."""
    return max(model[name], 1e-3 * model.kind.nominal[name])


def free_parameters(model: Model) -> tuple[Free, ...]:
    """What a fit may change: the faults first, then the suspects, then the tolerances."""
    clogging = Open(CLOGGING.parameter, 0.0, UNIT_TOLERANCE, UNKNOWN, math.log(1.0 - MOST), 0.0, 1.0)
    friction = [Ratio(f"spool.{kind}_friction", math.log(positive(model, f"spool.{kind}_friction")), UNIT_TOLERANCE,
                      UNKNOWN, math.log(LEAST), math.log(LARGEST), 1.0) for kind in ("static", "dynamic")]
    suspects = [_suspected(s, model) for s in SUSPECTS]
    usual = math.log(positive(model, "jack.static_friction") / positive(model, "jack.dynamic_friction"))
    over = Over("jack.static_friction", usual, 0.03, 1.0, 0.0, usual + 1.0, 0.3)
    taken = {f.name for f in (clogging, *friction, *suspects, over)}
    return (clogging, *friction, *suspects, over, *(_ratio(f) for f in free_of(model) if f.name not in taken))


def _suspected(s: Suspect, model: Model) -> Free:
    own = next(u for u in unknowns(CATALOGUE[s.effect], model) if u.name == s.parameter)
    usual = positive(model, s.parameter) if s.ratio else model.values.get(s.parameter, own.centre)
    if s.ratio:
        return Ratio(s.parameter, math.log(usual), s.spread, 1.0, math.log(0.05 * usual), math.log(100.0 * usual), 0.02)
    return own._replace(centre=usual, scale=s.spread, prior=1.0, step=0.02)


def _ratio(f: Free) -> Free:
    """A tolerance as one of the logarithm."""
    if f.low <= 0.0:
        return f
    return Ratio(f.name, math.log(f.centre), f.scale / f.centre, f.prior, math.log(f.low), math.log(f.high), f.step)


def start_of(free: Sequence[Free], kintas: float, fss: float, offsets: Mapping[str, float] | None = None,
             sliding: float = math.inf) -> Floats:
    """Scaled unknowns, (p,), of a plant that has the two faults and `offsets`, and is nominal otherwise.

    FDS goes with FSS, but not beyond `sliding` N.
    """
    logs = {CLOGGING.parameter: math.log(1.0 - min(max(kintas, 0.0), MOST)),
            FRICTION.parameter: math.log(max(fss, LEAST)),
            "spool.dynamic_friction": math.log(min(max(fss, LEAST) / SLIDING, sliding)), **(offsets or {})}
    return np.array([(logs.get(f.name, f.centre) - f.centre) / f.scale for f in free])

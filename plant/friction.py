"""A body pushed by a saturating pressure against dry and viscous friction: one exact implicit step.

Dry friction after Karnopp, without his velocity band (Borello): a body at rest stays at rest while the net force is
within the static level; one that moves is resisted by the dynamic level and stops where its velocity would change sign.
"""

from math import inf


def clip(x: float, limit: float) -> float:
    """`x` limited to +-`limit`; two selects, no branch."""
    x = x if x < limit else limit
    return x if x > -limit else -limit


def soften(x: float, band: float) -> float:
    """`x` less the dead zone [-band, band]: the impulse that dry friction leaves."""
    return x - clip(x, band)


def play(x: float, position: float, half: float) -> float:
    """The position of a part that `x` drags through a play of +-`half`; it was at `position`."""
    position = position if position > x - half else x - half
    return position if position < x + half else x + half


def solve_velocity(v0: float, impulse: float, push: float, line: float, slope: float, limit: float, dry: float,
          free: float, coupled: float) -> float:
    """Velocity after the step of  m v' = F + A clip(p0 - s v, +-limit) - c v - dry(v), implicit in v.

    The right side falls with v, so there is one root. It lies on the sloping part of the pressure or on the side of
    the limit that the sloping root points to; each is a soft threshold. No iteration, no branch.

    Args:
        v0: velocity before, m/s.
        impulse: m v0 + h F, N s.
        push: h A, N s/Pa.
        line: p0, pressure at standstill, Pa.
        slope: s, fall of the pressure with v, Pa s/m.
        limit: saturation pressure, Pa.
        dry: h times the dry friction level, N s.
        free: 1/(m + h c), one over the body's effective mass at the limit, 1/kg.
        coupled: 1/(m + h c + h A s), the same on the sloping part, 1/kg.
    """
    # the factors that do not wait for `line` are multiplied among themselves: the step is as long as its chain
    v = soften(coupled * impulse + coupled * push * line, coupled * dry)
    linear_pressure = line - slope * v
    pressure = clip(linear_pressure, limit)
    v = v if pressure == linear_pressure else soften(impulse + push * pressure, dry) * free
    # no further than zero; the bounds depend on v0 alone, so that only two selects wait for v
    low, high = 0.0 if v0 > 0.0 else -inf, 0.0 if v0 < 0.0 else inf
    v = v if v > low else low
    return v if v < high else high


def solve_sliding(v0: float, impulse: float, dry: float, free: float) -> float:
    """Velocity after the step of  m v' = F - c v - dry(v), implicit in v; friction stops it where it would turn round.

    Args:
        v0: velocity before, m/s or rad/s.
        impulse: m v0 + h F, N s or N m s.
        dry: h times the level of dry friction.
        free: 1/(m + h c), one over the effective mass or inertia.
    """
    v = soften(impulse, dry) * free
    low, high = 0.0 if v0 > 0.0 and dry > 0.0 else -inf, 0.0 if v0 < 0.0 and dry > 0.0 else inf
    v = v if v > low else low
    return v if v < high else high

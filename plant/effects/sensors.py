"""Effects of the position transducer, in the order of its signal path."""

from collections import namedtuple
from math import sqrt
from typing import Any

from numpy import floor

from plant.effects import Held, Lag, Quantity, effect, play

# how far the body has recoiled, its speed, and the force in metres of static recoil
Recoil = namedtuple("Recoil", "distance speed static", defaults=(0.0, 0.0, 0.0))


@effect("position", {  # Compliance 1/K of the actuator's mount, mass of the body on it, and damping ratio of the two.
    "compliance": Quantity("m/N", low=0, high=1e-3, typical="1e-8-1e-7 m/N, 1/K"),
    "mass": Quantity("kg", low=0, high=1e4, typical="0: a light body; 5-50 kg"),
    "damping_ratio": Quantity("1", low=0, high=10, typical="0.02-0.1"),
}, off={"damping_ratio": 0.05}, law="XJ = XJ + z, M z'' + 2 D sqrt(M K) z' + K z = AJ P12, K = 1/compliance",
    symptoms="position residual proportional to P12; with a heavy body it rings", memory=Recoil,
    starts=((1e-8, 0.0, 0.05), (3e-8, 0.0, 0.05), (1e-7, 0.0, 0.05), (4e-8, 20.0, 0.05)),
    source="a body on an elastic mount; without mass its static limit")
def mount_compliance(x: float, m: Recoil, s: Any, u: Any, p: Any) -> tuple[float, Recoil]:
    """The body recoils under the ram's force, and the transducer sees the ram against the body.

    One step of the theta method, its law divided by K. It is the trapezoidal rule, which damps nothing, where the body
    is slower than the step, and exact without mass.
    """
    g = p.mount_compliance
    inertia, step = g.mass * g.compliance, u.h * u.h  # s^2
    later = (inertia + step) / (2.0 * inertia + step)  # theta: 1/2 for a heavy body, 1 without mass
    static = g.compliance * p.jack.area * s.pressure
    pull = later * static + (1.0 - later) * m.static - m.distance
    damping = 2.0 * g.damping_ratio * sqrt(inertia)
    mean = (inertia * m.speed + later * u.h * pull) / (inertia + later * u.h * (damping + later * u.h))
    distance = m.distance + u.h * mean
    return x + distance, Recoil(distance, m.speed + (mean - m.speed) / later, static)


def drag_along(m: Held, moved: float) -> Held:
    """The rod where an anchored replay has moved the ram by `moved` m."""
    return Held(m.held + moved)


@effect("position", {  # Total play between ram and transducer.
    "width": Quantity("m", low=0, high=1, typical="20-200 um"),
}, law="XJ = play(XJ, width)", symptoms="lost motion at every reversal", memory=Held, shift=drag_along,
    starts=(2e-5, 6e-5, 2e-4), source="play operator, Krasnosel'skii and Pokrovskii 1989")
def rod_backlash(x: float, m: Held, s: Any, u: Any, p: Any) -> tuple[float, Held]:
    """A worn rod end: on reversal the transducer waits until the ram has crossed the play."""
    held = play(x, m.held, 0.5 * p.rod_backlash.width)
    return held, Held(held)


def move_last_input(m: Lag, moved: float) -> Lag:
    """The lag where an anchored replay has moved the ram by `moved` m: its output moves at once."""
    return Lag(m.behind, m.last + moved)


@effect("position", {  # First-order lag.
    "time": Quantity("s", low=0, high=0.1, typical="0.3-3 ms"),
}, law="tau XS' + XS = XJ", symptoms="roll-off in the sensed position", memory=Lag, shift=move_last_input,
    starts=(0.3e-3, 1e-3, 3e-3), confused_with=("transport_delay", "coil_lag"),
    source="demodulator and filter of an LVDT")
def sensor_lag(x: float, m: Lag, s: Any, u: Any, p: Any) -> tuple[float, Lag]:
    """Demodulator and anti-alias filter of the LVDT (trapezoidal rule on the part that lags, exact at tau = 0)."""
    two = 2.0 * p.sensor_lag.time
    behind = ((two - u.h) * m.behind - two * (x - m.last)) / (two + u.h)
    return x + behind, Lag(behind, x)


@effect("position", {  # Relative error of the transducer's gain.
    "error": Quantity("1", low=-1, high=1, typical="0.25-2 %"),
}, law="XJ = XJ (1 + error)", symptoms="residual proportional to position", starts=(0.003, -0.003, 0.02, -0.02),
    confused_with=("jack.area",), revealed_by="an end stop at a known position, or a second position sensor",
    source="calibration of the transducer")
def sensor_gain(x: float, s: Any, u: Any, p: Any) -> float:
    """The transducer's scale is not the ram's."""
    return x + p.sensor_gain.error * x


@effect("position", {  # Zero error of the transducer.
    "offset": Quantity("m", low=-1, high=1, typical="10-200 um"),
}, law="XJ = XJ + offset", symptoms="unobservable in closed loop except at end stops",
    starts=(3e-5, -3e-5, 2e-4, -2e-4), revealed_by="an end stop at a known position, or a second position sensor",
    source="calibration of the transducer")
def sensor_offset(x: float, s: Any, u: Any, p: Any) -> float:
    """The transducer's zero is not the ram's; behind the lag, which would else begin a run by catching up with it."""
    return x + p.sensor_offset.offset


# The least significant bit of the reading.
QUANTISATION = {"lsb": Quantity("m", low=0, high=1e-2, typical="1-20 um")}


@effect("reading", QUANTISATION, law="XJ = LSB round(XJ/LSB), noise included", symptoms="comb in the histogram",
        starts=(2e-6, 6e-6, 2e-5), source="analogue-digital converter")
def quantisation(x: float, s: Any, u: Any, p: Any) -> float:
    """The converter has a finite number of bits."""
    lsb = p.quantisation.lsb
    on = lsb > 1e-12
    return lsb * floor(x / (lsb if on else 1.0) + 0.5) if on else x

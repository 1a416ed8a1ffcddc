"""Effects of the hydraulic supply and of its oil."""

from collections import namedtuple
from math import pi, sin
from typing import Any

from plant.effects import Quantity, effect


@effect("supply", {  # Pulsation of the pump.
    "amplitude": Quantity("1", low=-1, high=1, typical="0.01-0.1"),
    "frequency": Quantity("Hz", above=0, high=1e5),
    "phase": Quantity("rad"),
}, off={"frequency": 50.0}, law="PSR (1 + a sin(2 pi f t + phase))", symptoms="a line in the spectrum of the residual",
    starts=tuple((0.05, f, 0.0) for f in (5.0, 20.0, 50.0, 100.0, 200.0)), source="flow ripple of piston pumps")
def supply_ripple(x: float, s: Any, u: Any, p: Any) -> float:
    """The pump's pistons are felt in the supply."""
    g = p.supply_ripple
    return x + g.amplitude * sin(2.0 * pi * g.frequency * (u.t + 0.5 * u.h) + g.phase)


# the flow as the pump feels it
Drawn = namedtuple("Drawn", "flow", defaults=(0.0,))


@effect("supply", {  # Fall of the supply pressure with the flow that is drawn, and the line's time constant.
    "slope": Quantity("Pa s/m3", "Kd", low=0, high=1e14, typical="0.5e10-2.5e10 Pa s/m3"),
    "time": Quantity("s", low=0, high=10),
}, off={"time": 2e-3}, law="PSR - Kd |QJ|, QJ = AJ XJ' + CLK P12 behind a lag of the line",
    symptoms="only in fast moves", memory=Drawn, fitted=("slope",), starts=(5e9, 1.2e10, 2.5e10),
    confused_with=("current_limit",), source="pump characteristic and line loss")
def supply_droop(x: float, m: Drawn, s: Any, u: Any, p: Any) -> tuple[float, Drawn]:
    """The pump does not hold its pressure when much flow is drawn."""
    g = p.supply_droop
    drawn = abs(p.jack.area * s.jack_speed + p.jack.leakage * s.pressure)
    flow = m.flow + (drawn - m.flow) * (u.h / (g.time + 0.5 * u.h))
    return x - g.slope / p.supply.pressure * flow, Drawn(flow)


@effect("viscosity", {  # Viscosity of the oil over the nominal one.
    "factor": Quantity("1", low=1e-2, high=1e3, typical="0.3-5"),
}, off={"factor": 1.0}, law="CJ, BF, 1/CLK times the factor", symptoms="several parameters change over minutes",
    starts=(0.5, 1.4, 2.5), source="viscosity of the oil against temperature")
def viscosity_drift(x: float, s: Any, u: Any, p: Any) -> float:
    """Cold oil drags more and leaks less."""
    return x * p.viscosity_drift.factor

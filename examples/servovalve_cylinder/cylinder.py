"""A servovalve moves a cylinder with a rod on one side: voltage in, position and both chamber pressures out.

    tau w' = V - w    QA = K w root(pS - pA), w > 0; K w root(pA - pT), w < 0    root(d) = sign(d) sqrt(|d|)
    CA pA' = QA - AA x' - CL (pA - pB)    CB pB' = QB + AB x' + CL (pA - pB)
    M x'' = AA pA - AB pB - C x' - dry(x') - load

QB is that of the two other edges. C of a chamber: hose, and oil of modulus B in its part of the stroke. Merritt,
Hydraulic Control Systems, 1967; dry friction after Karnopp 1985.
"""
from math import pi, sqrt
from typing import Annotated, Any, NamedTuple

from plant.declare import (
    Fault,
    Hold,
    Plant,
    Quantity,
    Signal,
    Step,
    base_effect,
    clip,
    port,
    soften,
    solve_sliding,
)


class Valve(NamedTuple):
    """A proportional valve or servovalve with four metering edges."""

    gain: Annotated[float, Quantity("m3/s/V/Pa^0.5", "K", low=1e-12, high=1e-5, tolerance=0.03)] = 5.5e-9
    overlap: Annotated[float, Quantity("V", low=0, high=10)] = 0.0  # half the dead zone
    offset: Annotated[float, Quantity("V", low=-10, high=10)] = 0.0  # of its null
    saturation: Annotated[float, Quantity("1/V", low=-0.05, high=0.1)] = 0.0  # share of the opening lost with each volt
    supply_to_b: Annotated[float, Quantity("1", low=0.05, high=20)] = 1.0  # width of an edge over that of the others
    b_to_tank: Annotated[float, Quantity("1", low=0.05, high=20)] = 1.0
    lag: Annotated[float, Quantity("s", "tau", low=1e-4, high=1, tolerance=0.05)] = 5e-3


class Supply(NamedTuple):
    """The pump with its relief valve, and the tank."""

    pressure: Annotated[float, Quantity("Pa", "pS", low=1e4, high=1e8, tolerance=0.02)] = 4.4e6
    droop: Annotated[float, Quantity("Pa s/m3", low=0, high=1e13)] = 0.0  # fall of the pressure with the flow drawn
    tank: Annotated[float, Quantity("Pa", "pT", low=0, high=1e7)] = 1e5


class Cylinder(NamedTuple):
    """The cylinder, its hoses and the mass that it moves. Pressures at rest are those before the first row."""

    bore: Annotated[float, Quantity("m", low=1e-3, high=2)] = 0.016
    rod: Annotated[float, Quantity("m", low=0, high=2)] = 0.010
    retracted: Annotated[float, Quantity("m", low=-100, high=100)] = 0.0  # reading at the inner end stop
    stroke: Annotated[float, Quantity("m", low=1e-3, high=100)] = 0.2
    mass: Annotated[float, Quantity("kg", "M", low=1e-2, high=1e6, tolerance=0.05)] = 5.0
    damping: Annotated[float, Quantity("N s/m", "C", low=0, high=1e7, tolerance=0.05)] = 100.0
    friction: Annotated[float, Quantity("N", "FD", low=0, high=1e6, tolerance=0.05)] = 0.0
    stiction: Annotated[float, Quantity("1", "FS/FD - 1", low=0, high=10)] = 0.0
    leakage: Annotated[float, Quantity("m3/s/Pa", "CL", low=0, high=1e-6)] = 0.0  # from chamber to chamber
    hose_a: Annotated[float, Quantity("m3/Pa", low=1e-17, high=1e-8, tolerance=0.05)] = 2e-13  # with dead volumes
    hose_b: Annotated[float, Quantity("m3/Pa", low=1e-17, high=1e-8, tolerance=0.05)] = 2e-13
    air_a: Annotated[float, Quantity("m3", low=0, high=1)] = 0.0  # free air in the oil, at atmospheric pressure
    air_b: Annotated[float, Quantity("m3", low=0, high=1)] = 0.0
    # 2: isothermal; 1: the modulus is in proportion to the pressure, as with dissolving air and hoses
    air_exponent: Annotated[float, Quantity("1", low=0, high=3)] = 1.0
    modulus: Annotated[float, Quantity("Pa", "B", low=1e7, high=1e10)] = 1.2e9
    rest_a: Annotated[float, Quantity("Pa", low=0, high=1e8)] = 2e6
    rest_b: Annotated[float, Quantity("Pa", low=0, high=1e8)] = 3.3e6


class Controller(NamedTuple):
    """The amplifier of the valve: it passes the demand on."""

    limit: Annotated[float, Quantity("V", above=0, high=1e3)] = 10.0
    period: Annotated[float, Quantity("s", low=1e-4, high=0.1)] = 1e-3


class State(NamedTuple):
    """The state at one instant; all zero is the cylinder at rest. Pressures are above those at rest."""

    opening: float = 0.0  # V, w
    drawn: float = 0.0  # m3/s, from the supply
    pressure_a: float = 0.0  # Pa
    pressure_b: float = 0.0
    position: float = 0.0  # m, x
    speed: float = 0.0  # m/s


class Coefficients(NamedTuple):
    """What follows from the parameters and the step."""

    area_a: float  # m2
    area_b: float
    per_modulus: float  # 1/Pa
    follow: float  # share of the way that the valve goes in a step
    mass: float  # kg, with what damping adds
    fill: float  # share of its way that the drawn flow goes


LAMINAR = 2e3  # Pa, below which the flow through an edge goes with the pressure and not with its root
ATMOSPHERE = 1.013e5  # Pa
SUPPLY_LAG = 5e-3  # s, of the supply pressure behind the flow


def compute_coefficients(p: Any, h: float) -> Coefficients:
    """Coefficients for steps of `h` seconds."""
    bore, rod = p.cylinder.bore, p.cylinder.rod
    return Coefficients(0.25 * pi * bore * bore, 0.25 * pi * (bore * bore - rod * rod), 1.0 / p.cylinder.modulus,
                        h / (p.valve.lag + h), p.cylinder.mass + h * p.cylinder.damping, h / (SUPPLY_LAG + h))


at_voltage = port("V", "voltage at the valve")
at_opening = port("V", "opening of the metering edges, as the voltage that gives it")
at_supply = port("Pa", "pressure of the supply")
at_load = port("N", "external force on the rod, against extension")


def meter(width: float, drop: float) -> tuple[float, float]:
    """Flow through an edge, m3/s, and its slope over the pressure drop, m3/s/Pa."""
    size = abs(drop) + LAMINAR
    root = sqrt(size)
    return width * drop / root, width * (0.5 * abs(drop) + LAMINAR) / (size * root)


def squeeze(volume: float, exponent: float, pressure: float) -> float:
    """Compliance of free air, m3/Pa: `volume` at atmospheric pressure, at a pressure above that, Pa."""
    ratio = ATMOSPHERE / (ATMOSPHERE + max(pressure, 0.0))
    return volume * ratio**exponent / ATMOSPHERE


def step(s: State, m: Any, u: Any, p: Any, k: Coefficients) -> tuple[State, Any]:
    """The state `u.h` seconds later.

    The pressures are implicit in themselves and in the speed: each is a line over the speed, and so is the force.
    """
    g, h = p.cylinder, u.h
    voltage, m = at_voltage(u.drive, m, s, u, p)
    opening = s.opening + k.follow * (voltage + p.valve.offset - s.opening)
    w = soften(opening, p.valve.overlap)
    w, m = at_opening(w * max(1.0 - p.valve.saturation * abs(w), 0.0), m, s, u, p)
    supply, m = at_supply(p.supply.pressure - p.supply.droop * s.drawn, m, s, u, p)
    load, m = at_load(u.load, m, s, u, p)
    pa, pb = s.pressure_a + g.rest_a, s.pressure_b + g.rest_b
    out, gain, tank = w > 0.0, p.valve.gain * abs(w), p.supply.tank
    flow_a, slope_a = meter(gain, (supply - pa) if out else (tank - pa))
    flow_b, slope_b = meter(gain * (p.valve.b_to_tank if out else p.valve.supply_to_b),
                            (tank - pb) if out else (supply - pb))
    drawn = s.drawn + k.fill * ((flow_a if out else flow_b) - s.drawn)
    leak = g.leakage * (pa - pb)
    extended = clip(s.position - g.retracted - 0.5 * g.stroke, 0.5 * g.stroke) + 0.5 * g.stroke
    soft_a = g.hose_a + k.area_a * extended * k.per_modulus + squeeze(g.air_a, g.air_exponent, pa)
    soft_b = g.hose_b + k.area_b * (g.stroke - extended) * k.per_modulus + squeeze(g.air_b, g.air_exponent, pb)
    share_a, share_b = h / (soft_a + h * slope_a), h / (soft_b + h * slope_b)  # Pa for each m3/s
    rest_a, rest_b = pa + share_a * (flow_a - leak), pb + share_b * (flow_b + leak)  # pressures of a ram held fast
    force = k.area_a * rest_a - k.area_b * rest_b - load
    stiffness = k.area_a * k.area_a * share_a + k.area_b * k.area_b * share_b
    dry = h * g.friction * (1.0 + (g.stiction if s.speed == 0.0 else 0.0))
    v = solve_sliding(s.speed, g.mass * s.speed + h * force, dry, 1.0 / (k.mass + h * stiffness))
    middle = g.retracted + 0.5 * g.stroke
    wanted = s.position + h * v - middle
    x = clip(wanted, 0.5 * g.stroke)
    v = v if x == wanted else 0.0
    return State(opening, drawn, rest_a - share_a * k.area_a * v - g.rest_a, rest_b + share_b * k.area_b * v - g.rest_b,
                 x + middle, v), m


def measure(s: State, p: Any) -> tuple[float, float, float]:
    """Position, m, and pressures of both chambers, Pa."""
    return s.position, s.pressure_a + p.cylinder.rest_a, s.pressure_b + p.cylinder.rest_b


def correct(s: State, distance: float, p: Any) -> State:
    """The rod moved by a distance, m, to correct a replay; one at rest stays, or noise would pump against a stop."""
    moved = distance if s.speed != 0.0 else 0.0
    return State(s.opening, s.drawn, s.pressure_a, s.pressure_b, s.position + moved, s.speed)


def control(c: float, demand: float, y: Any, p: Any) -> tuple[float, float]:
    """Voltage for the next cycle: there is no loop, the demand is the voltage."""
    return clip(demand, p.controller.limit), c


base_effect("dry_friction", Cylinder, "friction", law="dry(FD, x')", starts=(10.0, 50.0, 300.0),
            symptoms="the force steps with the sign of the speed", source="Karnopp 1985")
base_effect("stiction", Cylinder, "stiction", law="FS = FD (1 + stiction)", starts=(0.3, 2.0),
            symptoms="a peak of the force at break-away", source="Karnopp 1985")
base_effect("viscous_friction", Cylinder, "damping", law="C x'", starts=(50.0, 1e3, 5e3),
            symptoms="the force grows with speed", source="Merritt 1967")
base_effect("overlap", Valve, "overlap", law="w = deadzone(w, overlap)", starts=(0.1, 0.4, 1.0),
            symptoms="too slow at small voltages, both ways", source="lap of the spool's lands, Merritt 1967")
base_effect("flow_saturation", Valve, "saturation", law="w (1 - saturation |w|)", starts=(0.01, 0.03, -0.01),
            symptoms="too slow at large voltages, both ways", source="flow curve of a valve, ISO 10770-1")
base_effect("free_air", Cylinder, "air_a", "air_b", law="C = V/p0 (p0/p)^exponent more",
            starts=((1e-8, 1e-8), (5e-8, 5e-8), (3e-8, 0.0), (0.0, 3e-8)),
            symptoms="the pressure changes fast while it is high and slowly while it is low",
            source="free air in oil, Merritt 1967; dissolving air lowers the exponent")
base_effect("null_bias", Valve, "offset", law="w + offset", starts=(0.1, -0.1, 0.5, -0.5),
            symptoms="faster one way at small voltages", source="null shift of the valve, Merritt 1967")
base_effect("narrow_inlet_b", Valve, "supply_to_b", law="QB = K w ratio root(pS - pB), w < 0", starts=(0.8, 0.5, 1.3),
            symptoms="slower back, with less pressure in both chambers", source="edges of unequal width, Merritt 1967")
base_effect("narrow_outlet_b", Valve, "b_to_tank", law="QB = K w ratio root(pT - pB), w > 0", starts=(0.8, 0.5, 1.3),
            symptoms="slower out, with more pressure in both chambers", source="edges of unequal width, Merritt 1967")
base_effect("supply_droop", Supply, "droop", law="pS - droop Q, Q drawn", starts=(2e9, 1e10, 5e10),
            symptoms="too slow at large voltages", source="override of the relief valve, losses of the line")
base_effect("leakage", Cylinder, "leakage", law="CL (pA - pB)", starts=(1e-13, 1e-12, 1e-11),
            symptoms="pressures fall towards each other at an end stop", source="worn piston seal, Merritt 1967")

PLANT = Plant(
    title="servovalve and cylinder with a rod on one side",
    signals=(Signal("demand", "V_d", "V", "demanded voltage of the valve", "command", largest=100.0),
             Signal("position", "x", "m", "position of the rod", noise=2e-4, largest=1.0, shown="mm", noun="rod"),
             Signal("voltage", "V", "V", "voltage of the valve", "drive", limit="controller.limit"),
             Signal("pressure_a", "p_A", "Pa", "pressure of chamber A, which extends", noise=2.5e4, shown="bar"),
             Signal("pressure_b", "p_B", "Pa", "pressure of chamber B", noise=2.5e4, shown="bar"),
             Signal("load", "load", "N", "external force on the rod", "load", largest=1e6)),
    parameters=(Valve, Supply, Cylinder, Controller),
    state=State, step=step, coefficients=compute_coefficients, measure=measure, moves=("position",), correct=correct,
    control=control,
    faults=(Fault("leakage", "leakage across the piston", "cylinder.leakage", (0.0, 1e-11), 1e-12, 4e-12,
                  "limits are ours: 3 and 12 % of the flow at 3 V"),),
    profile=(Hold(time=0.1), Step(to=3.0, time=2.5), Step(to=0.0, time=0.2), Step(to=-3.0, time=3.0),
             Step(to=1.0, time=2.0), Step(to=-5.0, time=1.0)),
)

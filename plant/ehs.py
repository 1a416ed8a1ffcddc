"""An electro-hydrostatic position servo: a motor turns a pump, the pump moves a ram that presses against a load.

Nominal is the bare integrator, a ram as fast as the pump delivers; what else there is, `rig explain` has to find. Rig
and data: github.com/ivliev123/Electro-Hydraulic-Actuator; "raw" is the unit of its motor speed, not stated there.
"""
from collections import namedtuple
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np

from plant.effects import base
from plant.effects.sensors import Quantisation
from plant.effects.valve import Compressibility
from plant.parameters import GROUPS, convert_group_unit, read_shipped_model
from plant.plants import Array, Plant, Table, Term
from plant.ports import at_current, at_position, at_valve
from plant.quantity import Quantity
from plant.state import Input, Line, Ports, State
from plant.step import step_jack

ROD_SIDE = 0.686  # area of the rod side over that of the piston side; a 50 mm piston usually has a 28 mm rod
SEAL_LEAKAGE = 1e-16  # m3/s/Pa, negligible; it keeps the pressure finite in a model without leakage


class Pump(NamedTuple):
    """The pump, and the valve that gives its flow to one chamber and the other chamber to the tank."""

    displacement: Annotated[float, Quantity("m3/s/raw", "D", low=1e-10, high=1e-6)]
    area_ratio: Annotated[float, Quantity("1", low=0.1, high=2)]  # that the flow meets, backwards over forwards
    drain: Annotated[float, Quantity("s", low=1e-3, high=10)]  # time constant of a chamber that is given to the tank


Coefficients = namedtuple("Coefficients", "gain valve_slope jack_damping jack_free jack_coupled")


def compute_servo_coefficients(p: Any, h: float) -> Any:
    """Coefficients of D w = AJ XJ' + CLK P12, solved for P12."""
    slope, mass = p.jack.area / (p.jack.leakage + SEAL_LEAKAGE), p.jack.mass + h * p.jack.damping
    return Coefficients(p.pump.displacement / p.jack.area * slope, slope, p.jack.damping, 1.0 / mass,
                        1.0 / (mass + h * p.jack.area * slope))


def step_servo(s: State, u: Input, p: Any, k: Any) -> State:
    """The state `u.h` seconds later; P12 is the force on the ram over the area of the piston's larger side."""
    m = s.memory
    w, m_current = at_current(u.current, m.current, s, u, p)
    r = 1.0 if (w if w != 0.0 else s.pressure) >= 0.0 else p.pump.area_ratio  # without flow the valve is closed
    held = s.pressure * (1.0 if w * s.pressure >= 0.0 else p.pump.drain / (p.pump.drain + u.h))
    before = State(0.0, 0.0, 0.0, 0.0, s.jack_position, s.jack_speed, held, s.sensed, m)
    pump = Line(r * k.gain * w, r * r * k.valve_slope, p.supply.pressure, 0.0)
    line, m_valve = at_valve(pump, m.valve, before, u, p)
    x, v, p12, m_load, m_drag = step_jack(s, u, p, k, line, 0.0)
    sensed, m_position = at_position(x, m.position, State(0.0, 0.0, 0.0, 0.0, x, v, p12, s.sensed, m), u, p)
    return State(0.0, 0.0, 0.0, 0.0, x, v, p12, sensed, Ports(
        m.command, m_current, m.supply, m.viscosity, m.nozzle, m.feedback, m.spool_force, m.metering, m_valve, m_load,
        m_drag, m_position, m.reading))


def estimate_load(columns: Mapping[str, Array]) -> Array:
    """The constant load of a run, N, (n,): the mean of the pressure forces of both directions, where friction cancels.

    `columns` holds com, m, and p12, Pa, each (n,).
    """
    rate, p12 = np.diff(columns["com"], prepend=columns["com"][0]), columns["p12"]
    return np.full_like(p12, NOMINAL["jack.area"] * (np.nanmedian(p12[rate > 0.0]) + np.nanmedian(p12[rate < 0.0])))


base("unequal_areas", "pump.area_ratio", groups={"pump": Pump}, plant="ehs", law="AJ times the ratio, backwards",
     symptoms="another speed backwards for the same drive", starts=(0.9, 0.7, 0.5), source="a rod on one side")

PARAMETER_GROUPS: dict[str, type[Any]] = {
    "controller": convert_group_unit(GROUPS["controller"], "A", "raw", 1e6),
    "pump": Pump,
    "supply": GROUPS["supply"],
    "jack": GROUPS["jack"],
    "sensors": GROUPS["sensors"],
}
EFFECT_GROUPS = {"quantisation": Quantisation, "compressibility": Compressibility}  # the model file has values for them
NOMINAL = read_shipped_model("ehs.toml", {**PARAMETER_GROUPS, **EFFECT_GROUPS})

# The pressures in the file are means of the last 20 and 60 rows: `Term.later` shifts them back by half of that.
COLUMNS = {
    "t": (Term("EXP_Time"),),
    "com": (Term("EXP_PosRef", 1e-3),),
    "xj": (Term("EXP_PosFb", 1e-3),),
    "cor": (Term("EXP_Velocity"),),
    "p12": (Term("EXP_Pressure_A", 1e5, 10), Term("EXP_Pressure_B", -ROD_SIDE * 1e5, 30)),
}

PLANT = Plant(
    name="ehs",
    unit="raw",
    step=step_servo,
    coefficients=compute_servo_coefficients,
    groups=PARAMETER_GROUPS,
    given=NOMINAL,
    has=("quantisation",),
    lacks=("constant_load", "aero_stiffness", "sensor_gain", "sensor_lag", "sensor_offset"),
    controller=False,
    scatter={"pump.displacement": 0.1},
    table=Table(skip=60, separator=";", load=estimate_load, columns=COLUMNS),
)

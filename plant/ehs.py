"""An electro-hydrostatic position servo: a motor turns a pump, the pump moves a ram that presses against a load.

Nominal is the bare integrator, a ram as fast as the pump delivers; what else there is, `rig explain` has to find: the
load of a recording is that of a press, and how it acts on the ram (`loaded_by`) is part of the question. Rig and data:
github.com/ivliev123/Electro-Hydraulic-Actuator; "raw" is the unit of its motor speed, not stated there.
"""
from collections import namedtuple
from collections.abc import Mapping

import numpy as np

from plant.declare import Any, NamedTuple, Plant, Quantity, base_effect, clip, port
from plant.effects.sensors import QUANTISATION
from plant.effects.servovalve import COMPRESSIBILITY
from plant.eha import step_jack, update_compliance
from plant.parameters import GROUPS, convert_group_unit, read_shipped_model
from plant.plants import MeasuredPressures, Table, Term
from plant.ports import at_position, at_valve
from plant.quantity import make_group
from plant.segments import Array
from plant.signals import EHA, Signals
from plant.state import Input, Line, Memory

ROD_SIDE = 0.686  # area of the rod side over that of the piston side; a 50 mm piston usually has a 28 mm rod
COUNT = 2.5e-5  # m a count of the position sensor and of the demand
RAW_PER_TURN = 60.0 / 0.88  # raw/(turn/s): the firmware calls its unit rpm; by the encoder one is 0.88 rpm
at_current = port("raw", "speed of the motor")
SEAL_LEAKAGE = 1e-16  # m3/s/Pa, negligible; it keeps the pressure finite in a model without leakage

Pump = make_group("Pump", "The pump, and the valve that gives its flow to one chamber and the other to the tank.", {
    "displacement": Quantity("m3/s/raw", "D", low=1e-10, high=1e-6),
    "area_ratio": Quantity("1", low=0.1, high=2),  # that the flow meets, backwards over forwards
    "drain": Quantity("s", low=1e-3, high=10),  # time constant of a chamber that is given to the tank
    "least_speed": Quantity("raw", low=0, high=1e3),  # of the motor; below it the ram is locked
    "return_pressure": Quantity("Pa", low=0, high=1e7),  # of both chambers at rest
    "settling": Quantity("Pa/s", low=0, high=1e9),  # how fast the locked line gets there
    "pressure_given": Quantity("1", low=0, high=1),  # 1: the load is the force of measured pressures
}, __name__)

PressureSensors = make_group("PressureSensors", "By how much readings of the chambers are late; negative: early.", {
    "delay_a": Quantity("s", low=-0.1, high=0.1),  # chamber A, which extends the ram
    "delay_b": Quantity("s", low=-0.1, high=0.1),  # chamber B
}, __name__)

Coefficients = namedtuple("Coefficients", "gain valve_slope jack_damping jack_free jack_coupled")


def compute_servo_coefficients(p: Any, h: float) -> Any:
    """Coefficients of D w = AJ XJ' + CLK P12, solved for P12."""
    slope, mass = p.jack.area / (p.jack.leakage + SEAL_LEAKAGE), p.jack.mass + h * p.jack.damping
    return Coefficients(p.pump.displacement / p.jack.area * slope, slope, p.jack.damping, 1.0 / mass,
                        1.0 / (mass + h * p.jack.area * slope))


class State(NamedTuple):
    """The servo at one instant; all zero is the ram at rest in the middle."""

    jack_position: float = 0.0  # m, XJ
    jack_speed: float = 0.0  # m/s
    pressure: float = 0.0  # Pa, P12, the force on the ram over the area of the piston's larger side
    sensed: float = 0.0  # m, XJ as its transducer shows it, without noise


def step_servo(s: State, m: Memory, u: Input, p: Any, k: Any) -> tuple[State, Memory]:
    """The state `u.h` seconds later.

    Where the pressures were measured and are given as a load, the ram has the speed at which the pump's line has that
    pressure, XJ' = (p0 - p)/slope: the flow alone, without the forces on the ram.
    """
    w, m = at_current(u.drive, m, s, u, p)
    r = 1.0 if (w if w != 0.0 else s.pressure) >= 0.0 else p.pump.area_ratio  # without flow the valve is closed
    rest = (1.0 - p.pump.area_ratio) * p.pump.return_pressure  # one pressure on unequal areas
    held = s.pressure * (1.0 if w * s.pressure >= 0.0 else p.pump.drain / (p.pump.drain + u.h))
    is_given, given = p.pump.pressure_given > 0.5, u.load / p.jack.area
    held = (s.pressure if given * s.pressure > 0.0 else given) if is_given else held  # another chamber starts anew
    before = State(s.jack_position, s.jack_speed, held, s.sensed)
    pump = Line(r * k.gain * w, r * r * k.valve_slope, p.supply.pressure, 0.0)
    line, m = at_valve(pump, m, before, u, p)
    x, v, p12, m = step_jack(s, m, u, p, k, line, 0.0)
    flow_speed = (line.offset - given) / line.slope
    x = clip(s.jack_position + u.h * flow_speed, p.jack.travel) if is_given else x
    v = flow_speed if is_given else v
    is_locked = abs(w) < p.pump.least_speed
    x, v = s.jack_position if is_locked else x, 0.0 if is_locked else v
    settled = line.offset + clip(rest - line.offset, u.h * p.pump.settling)
    p12 = clip(settled, line.limit) if is_locked else p12
    p12 = given if is_given else p12
    return sense_ram(State(x, v, p12, s.sensed), m, u, p)


def sense_ram(s: State, m: Memory, u: Input, p: Any) -> tuple[State, Memory]:
    """The state with what the ram's transducer shows of it."""
    sensed, m = at_position(s.jack_position, m, s, u, p)
    return State(s.jack_position, s.jack_speed, s.pressure, sensed), m


def measure(s: State, p: Any) -> tuple[float, float, float]:
    """What the transducers show: XJ m, P12 Pa, and XS, which a servo without a spool does not have, 0."""
    return s.sensed, s.pressure, 0.0


def estimate_load(columns: Mapping[str, Array]) -> Array:
    """The constant load of a run, N, (n,): the mean of the pressure forces of both directions, where friction cancels.

    `columns` holds com, m, and p12, Pa, each (n,).
    """
    rate, p12 = np.diff(columns["com"], prepend=columns["com"][0]), columns["p12"]
    return np.full_like(p12, NOMINAL["jack.area"] * (np.nanmedian(p12[rate > 0.0]) + np.nanmedian(p12[rate < 0.0])))


def estimate_load_in_motion(columns: Mapping[str, Array], rows: int = 200) -> Array:
    """The same for runs with short strokes, from the rows in which the ram is near its full speed; needs xj, m.

    The speed is taken over so many `rows`; full is above half of the highest either way.
    """
    xj, p12 = columns["xj"], columns["p12"]
    way = np.gradient(compute_centred_mean(xj, rows + 1))
    out, back = p12[way > 0.5 * way.max()], p12[way < 0.5 * way.min()]
    return np.full_like(p12, NOMINAL["jack.area"] * (np.nanmedian(out) + np.nanmedian(back)))


def compute_pressure_force(values: Mapping[str, float], chambers: Array, cor: Array, period: float) -> Array:
    """The force on the ram by the pressure of the chamber that the pump feeds, (n,) N, positive against extension.

    The other chamber is connected to the tank. Which one is fed follows from the sign of the motor's speed; without
    speed it is the last. The readings are moved back by the delays of their sensors.

    Args:
        values: parameters, "group.field" to SI value.
        chambers: (n, 2) pressures of the chambers A and B as they were read, Pa.
        cor: (n,) speed of the motor, raw, positive out.
        period: of a row, s.
    """
    rows = np.arange(len(cor))
    a, b = (np.maximum(np.interp(rows + values[f"pressure_sensors.delay_{name}"] / period, rows, column), 0.0)
            for name, column in zip("ab", chambers.T, strict=True))
    last = np.maximum.accumulate(np.where(cor != 0.0, rows, 0))
    return np.asarray(np.where(cor[last] < 0.0, -values["pump.area_ratio"] * b, a) * values["jack.area"])


def derive_logger_columns(sources: Mapping[str, Array]) -> dict[str, Array]:
    """The columns cor, raw, and pa, pb and p12, Pa, (n,) each, from those of the rig's logger.

    The motor's speed comes from the shaft's encoder, whose counts fall, and gets the sign of the directional valve. The
    motor turns one way: a count back is noise. The pressures are means of 9 and of 25 rows around a row.
    """
    counts = (-np.diff(sources["ADC1_Channel_6"], prepend=sources["ADC1_Channel_6"][0]) + 2048.0) % 4096.0 - 2048.0
    angle = np.maximum.accumulate(np.cumsum(counts)) / 4096.0
    turns = np.diff(angle, prepend=angle[0]) / (np.gradient(sources["time"]) * 1e-3)
    pa = compute_centred_mean((0.0625 * sources["ADC1_Channel_2"] - 0.625) * 1e5, 9)
    pb = compute_centred_mean((0.07576 * sources["ADC1_Channel_3"] - 18.333) * 1e5, 25)
    return {"cor": turns * RAW_PER_TURN * np.sign(sources["ADC1_Channel_16"]), "pa": pa, "pb": pb,
            "p12": pa - ROD_SIDE * pb}


def compute_centred_mean(x: Array, rows: int) -> Array:
    """The mean of so many rows (odd) around each row of `x`, (n,); the ends are repeated."""
    return np.convolve(np.pad(x, rows // 2, "edge"), np.full(rows, 1.0 / rows), "valid")


base_effect("check_valve", Pump, "least_speed", starts=(10.0, 40.0),
            law="XJ' = 0 while the motor is slower than that",
            symptoms="at rest the pressure falls and the ram stays",
            source="a pilot-operated check valve between pump and cylinder")
base_effect("return_pressure", Pump, "return_pressure", starts=(1e5, 5e5),
            law="Q = AJ XJ' + CLK (P12 - (1 - ratio) pR)",
            symptoms="at rest P12 falls to the same pressure from both sides",
            source="a return line under pressure and unequal areas")
base_effect("unequal_areas", Pump, "area_ratio",
            law="AJ times the ratio, backwards",
            symptoms="another speed backwards for the same drive", starts=(0.9, 0.7, 0.5), source="a rod on one side")

PARAMETER_GROUPS: dict[str, type[Any]] = {
    "controller": convert_group_unit(GROUPS["controller"], "A", "raw", 1e6),
    "pump": Pump,
    "supply": GROUPS["supply"],
    "jack": GROUPS["jack"],
    "sensors": GROUPS["sensors"],
    "pressure_sensors": PressureSensors,
}
# the model file has values for these effects
EFFECT_GROUPS = {"quantisation": QUANTISATION, "compressibility": COMPRESSIBILITY}
NOMINAL = read_shipped_model("ehs.toml", {
    **PARAMETER_GROUPS, **{name: make_group(name, "", fields, __name__) for name, fields in EFFECT_GROUPS.items()}})

# The pressures in the file are means of the last 20 and 60 rows: `Term.later` shifts them back by half of that.
PROCESSED_COLUMNS = {
    "t": (Term("EXP_Time"),),
    "com": (Term("EXP_PosRef", 1e-3),),
    "xj": (Term("EXP_PosFb", 1e-3),),
    "cor": (Term("EXP_Velocity"),),
    "p12": (Term("EXP_Pressure_A", 1e5, 10), Term("EXP_Pressure_B", -ROD_SIDE * 1e5, 30)),
}

LOGGER_COLUMNS = {
    "t": (Term("time", 1e-3),),
    "com": (Term("ADC1_Channel_13", COUNT),),
    "xj": (Term("ADC1_Channel_14", COUNT),),
}
LOGGER_SOURCES = ("time", "ADC1_Channel_2", "ADC1_Channel_3", "ADC1_Channel_6", "ADC1_Channel_16")

PLANT = Plant(
    title="electrohydrostatic servo: a pump moves the ram",
    signals=Signals(*(s._replace(unit="raw", quantity="speed of the motor", noun="motor") if s.role == "drive" else s
                      for s in EHA[1:])),
    parameters=PARAMETER_GROUPS,
    state=State,
    step=step_servo,
    measure=measure,
    moves=("jack_position",),
    coefficients=compute_servo_coefficients,
    sense=sense_ram,
    variants={"compute_compliance": (update_compliance, frozenset())},
    values=NOMINAL,
    has=("quantisation",),
    loaded_by=("external_load", "one_way_load"),
    shared_starts=True,
    lacks=("constant_load", "aero_stiffness", "sensor_gain", "sensor_lag", "sensor_offset"),
    scatter={"pump.displacement": 0.1},
    tables=(Table(skip=60, separator=";", load=estimate_load, columns=PROCESSED_COLUMNS),
            Table(skip=60, separator=";", load=estimate_load_in_motion, columns=LOGGER_COLUMNS,
                  derive=derive_logger_columns, derived_from=LOGGER_SOURCES)),
    measured_pressures=MeasuredPressures(
        compute_pressure_force,
        used=frozenset({"pressure_sensors.delay_a", "pressure_sensors.delay_b", "pump.area_ratio", "jack.area"}),
        # the preload is in the measured pressures already
        given={"pump.pressure_given": 1.0, "undissolved_air.preload": 0.0}),
)

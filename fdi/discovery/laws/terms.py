"""The terms that a law may consist of: readable formulas of the states, each with one coefficient.

A formula stands here once, as text. The regression evaluates it on measured states, the replay compiles it, and the
effect file of a law contains it.
"""
from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

STATES = {"position": "s.jack_position", "speed": "s.jack_speed", "pressure": "s.pressure",
          "spool": "s.spool_position", "spool_speed": "s.spool_speed", "current": "u.current", "time": "u.t",
          "way": "way"}
"""The states in a formula, and what they are in a law; `way` is the distance since the ram's last reversal, m."""

UNITS = {"position": "m", "speed": "m/s", "pressure": "Pa", "spool": "m", "spool_speed": "m/s", "current": "A",
         "time": "s", "way": "m"}

PARTS = {"load": ("force", "1", "a force against extension"),
         "damping": ("force", "speed", "a resistance times the ram's speed"),
         "dry": ("force", "direction", "a dry friction"),
         "flow": ("flow", "1", "a flow that leaves the jack"),
         "conductance": ("flow", "pressure", "a leakage across the piston times the pressure"),
         "area": ("flow", "speed", "a displacement times the ram's speed"),
         "current": ("current", "1", "a current that does not reach the torque motor")}
"""The ways in which a term enters its balance: the balance, what the factor is multiplied by there, in words."""


class Shape(NamedTuple):
    """A parameter inside a formula, in the unit of a state: a length, a scale, a frequency."""

    name: str
    state: str  # whose range gives the trial values
    kind: str  # "period", "scale" or "frequency"

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return "Hz" if self.kind == "frequency" else UNITS[self.state]


class Term(NamedTuple):
    """One term: `factor` is its formula without the coefficient, in the words of `STATES`; {name} is a shape."""

    name: str
    part: str  # one of PARTS
    factor: str
    unit: str  # of the coefficient
    words: str
    shape: Shape | None = None
    is_wave: bool = False  # the formula has a {phase} too

    @property
    def place(self) -> str:
        """The balance that it belongs to."""
        return PARTS[self.part][0]

    @property
    def fields(self) -> tuple[str, ...]:
        """Its parameters: the coefficient, the shape, the phase."""
        shape = (f"{self.name}_{self.shape.name}",) if self.shape else ()
        return (self.name, *shape, *((f"{self.name}_phase",) if self.is_wave else ()))

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return (self.unit, *((self.shape.unit,) if self.shape else ()), *(("rad",) if self.is_wave else ()))

    def format_factor(self, parameters: Mapping[str, object]) -> str:
        """The formula with its shape and phase as in `parameters`, by field."""
        names = {"phase": parameters.get(f"{self.name}_phase", 0.0)}
        if self.shape:
            names[self.shape.name] = parameters[f"{self.name}_{self.shape.name}"]
        return self.factor.format(**names)


_PERIOD = Shape("length", "position", "period")
_FREQUENCY = Shape("frequency", "time", "frequency")
_WAVE = "sin(2.0 * pi * position / {length} + {phase})"
_HUM = "sin(2.0 * pi * {frequency} * time + {phase})"
_BEYOND = "max(position - {gap}, 0.0) - max(-position - {gap}, 0.0)"

TERMS: tuple[Term, ...] = (
    Term("load", "load", "1.0", "N", "a constant force"),
    Term("spring", "load", "position", "N/m", "a spring"),
    Term("spring_difference", "load", "abs(position)", "N/m", "a spring that is stiffer on one side"),
    Term("spring_square", "load", "position * abs(position)", "N/m2", "a spring whose force grows with the square"),
    Term("spring_even", "load", "position * position", "N/m2", "a force quadratic in position, the same on both sides"),
    Term("spring_cube", "load", "position * position * position", "N/m3", "a spring whose force grows with the cube"),
    Term("contact", "load", _BEYOND, "N/m", "a spring behind a gap", Shape("gap", "position", "scale")),
    Term("cogging", "load", _WAVE, "N", "a force periodic in position", _PERIOD, True),
    Term("vibration", "load", _HUM, "N", "a force periodic in time", _FREQUENCY, True),
    Term("load_drift", "load", "time", "N/s", "a force that grows with time"),
    Term("area_difference", "load", "abs(pressure)", "m2", "a piston area that differs with the sign of P12"),
    Term("drag", "damping", "1.0", "N s/m", "viscous drag"),
    Term("drag_square", "damping", "abs(speed)", "N s2/m2", "drag that grows with the square of the speed"),
    Term("drag_cube", "damping", "speed * speed", "N s3/m3", "drag that grows with the cube of the speed"),
    Term("drag_difference", "damping", "1.0 * (speed > 0.0)", "N s/m", "drag in extension only"),
    Term("drag_slope", "damping", "position", "N s/m2", "drag that grows along the stroke"),
    Term("drag_outer", "damping", "abs(position)", "N s/m2", "drag that grows away from the middle"),
    Term("drag_pressure", "damping", "abs(pressure)", "N s/(m Pa)", "drag that grows with the pressure"),
    Term("drag_drift", "damping", "time", "N/m", "drag that grows with time"),
    Term("friction", "dry", "1.0", "N", "dry friction"),
    Term("friction_pressure", "dry", "abs(pressure)", "N/Pa", "dry friction that grows with the pressure"),
    Term("friction_slope", "dry", "position", "N/m", "dry friction that grows along the stroke"),
    Term("friction_outer", "dry", "abs(position)", "N/m", "dry friction that grows away from the middle"),
    Term("friction_square", "dry", "position * position", "N/m2", "dry friction quadratic in position"),
    Term("friction_wave", "dry", _WAVE, "N", "dry friction periodic in position", _PERIOD, True),
    Term("friction_difference", "dry", "1.0 * (speed > 0.0)", "N", "dry friction in extension only"),
    Term("friction_rise", "dry", "exp(-abs(speed) / {speed})", "N", "dry friction that falls with the speed",
         Shape("speed", "speed", "scale")),
    Term("friction_run_in", "dry", "exp(-way / {length})", "N", "dry friction that fades after each reversal",
         Shape("length", "way", "scale")),
    Term("friction_drift", "dry", "time", "N/s", "dry friction that grows with time"),
    Term("flow", "flow", "1.0", "m3/s", "a constant flow"),
    Term("flow_spool", "flow", "spool", "m2/s", "a lower flow gain"),
    Term("flow_square", "flow", "spool * abs(spool)", "m/s", "a flow gain that falls with the opening"),
    Term("flow_difference", "flow", "abs(spool)", "m2/s", "a flow gain that differs with the sign of the opening"),
    Term("flow_even", "flow", "spool * spool", "m/s", "a flow quadratic in the opening, the same on both sides"),
    Term("flow_cube", "flow", "spool * spool * spool", "1/s", "a flow loss that grows with the cube of the opening"),
    Term("flow_edge", "flow", "tanh(spool / {width})", "m3/s", "a flow lost at the null, within a width of it",
         Shape("width", "spool", "scale")),
    Term("flow_position", "flow", "spool * position", "m/s", "a flow gain that changes along the stroke"),
    Term("flow_pressure", "flow", "spool * abs(pressure)", "m2/(s Pa)", "a flow gain that falls with the pressure"),
    Term("flow_drift", "flow", "spool * time", "m2/s2", "a flow gain that falls with time"),
    Term("flow_ripple", "flow", _HUM, "m3/s", "a flow periodic in time", _FREQUENCY, True),
    Term("leakage", "conductance", "1.0", "m3/(s Pa)", "leakage across the piston"),
    Term("leakage_square", "conductance", "abs(pressure)", "m3/(s Pa2)", "leakage with the square of the pressure"),
    Term("leakage_root", "conductance", "1.0 / sqrt(abs(pressure) + 1e4)", "m3/(s Pa0.5)",
         "leakage through an orifice, with the root of the pressure"),
    Term("leakage_one_way", "conductance", "1.0 * (pressure > 0.0)", "m3/(s Pa)", "leakage for positive P12 only"),
    Term("leakage_slope", "conductance", "position", "m2/(s Pa)", "leakage that grows along the stroke"),
    Term("leakage_outer", "conductance", "abs(position)", "m2/(s Pa)", "leakage that grows away from the middle"),
    Term("leakage_wave", "conductance", _WAVE, "m3/(s Pa)", "leakage periodic in position", _PERIOD, True),
    Term("leakage_drift", "conductance", "time", "m3/(s2 Pa)", "leakage that grows with time"),
    Term("area", "area", "1.0", "m2", "a larger displacement"),
    Term("area_slope", "area", "position", "m", "a displacement that changes along the stroke"),
    Term("area_outer", "area", "abs(position)", "m", "a displacement that changes away from the middle"),
    Term("area_square", "area", "position * position", "1", "a displacement quadratic in position"),
    Term("area_direction", "area", "1.0 * (speed > 0.0)", "m2", "a displacement that differs in extension"),
    Term("bias", "current", "1.0", "A", "a constant current"),
    Term("gain", "current", "current", "1", "a lower gain of the torque motor"),
    Term("gain_difference", "current", "abs(current)", "1", "a gain that differs with the sign of the current"),
    Term("gain_square", "current", "current * abs(current)", "1/A", "a gain that falls with the current"),
    Term("gain_even", "current", "current * current", "1/A", "a current quadratic in the current"),
    Term("gain_cube", "current", "current * current * current", "1/A2", "a current lost with the cube of the current"),
    Term("dead_band", "current", "min(max(current, -{width}), {width})", "1",
         "the share of the current that is lost within a band about zero", Shape("width", "current", "scale")),
    Term("current_edge", "current", "tanh(current / {width})", "A", "a current lost at zero, within a width of it",
         Shape("width", "current", "scale")),
    Term("feedback", "current", "spool", "A/m", "a stiffer feedback spring"),
    Term("feedback_difference", "current", "abs(spool)", "A/m", "a feedback spring that is stiffer on one side"),
    Term("feedback_square", "current", "spool * abs(spool)", "A/m2", "a feedback spring that grows with the square"),
    Term("feedback_cube", "current", "spool * spool * spool", "A/m3", "a feedback spring that grows with the cube"),
    Term("spool_drag", "current", "tanh(spool_speed / {speed})", "A", "a current that the spool's direction costs",
         Shape("speed", "spool_speed", "scale")),
    Term("current_pressure", "current", "pressure", "A/Pa", "a current that the load pressure costs"),
    Term("gain_pressure", "current", "current * abs(pressure)", "1/Pa", "a gain that falls with the pressure"),
    Term("gain_drift", "current", "current * time", "1/s", "a gain that falls with time"),
    Term("bias_drift", "current", "time", "A/s", "a current that grows with time"),
    Term("ripple", "current", _HUM, "A", "a current periodic in time", _FREQUENCY, True),
)


def find_states(term: Term) -> list[str]:
    """The states in a term's formula."""
    words = re.findall(r"[a-z_]+", re.sub(r"{[a-z]+}", "", term.factor))
    return [state for state in STATES if state in words]

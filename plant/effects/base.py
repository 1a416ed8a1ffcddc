"""The effects that the reference model has already: missing means that their parameter is off its nominal value."""
from __future__ import annotations

from plant.effects import base

base("filter_clogging", "filter.clogging",
     law="PS1, GPF scale with 1 - Kintas, GQF with its power 1/2 (law sqrt), 1 (linear) or 0 (pressure)",
     symptoms="overshoot and settling; nothing on the slow ramp; same as a loss of pilot flow gain")
base("spool_friction", "spool.static_friction", "spool.dynamic_friction",
     law="dry(FSS, FDS, XS') on the spool",
     symptoms="rectangular current-spool loop of fixed width, stuck spool with quiet P12, limit cycle")
base("jack_friction", "jack.static_friction", "jack.dynamic_friction",
     law="dry(FSJ, FDJ, XJ') on the ram",
     symptoms="square wave of P12 with sign(v); position hardly moves")
base("viscous_drag", "jack.damping", law="CJ XJ'", symptoms="P12 proportional to v")
base("moving_mass", "jack.mass", law="MJ XJ''", symptoms="P12 proportional to acceleration")
base("internal_leakage", "jack.leakage", law="QJ = AJ XJ' + CLK P12",
     symptoms="offset or speed proportional to P12; invisible without load")

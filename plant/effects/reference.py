"""The effects that the reference model has already: missing means that their parameter is off its nominal value."""

from plant.effects import register_base

_PAPER = "the reference model of the source paper (its Fig. 5)"
_KARNOPP = "Karnopp 1985, without a velocity band (Borello); " + _PAPER

register_base("filter_clogging", "filter.clogging",
              law="PS1, GPF scale with 1 - Kintas, GQF with its power 1/2 (law sqrt), 1 (linear) or 0 (pressure)",
              symptoms="overshoot and settling; nothing on the slow ramp; same as a loss of pilot flow gain",
              starts=(0.05, 0.2, 0.45), confused_with=("pilot.flow_gain",),
              revealed_by="a gauge behind the filter, or a comparison with the new unit", source=_PAPER)
register_base("spool_friction", "spool.static_friction", "spool.dynamic_friction",
              law="dry(FSS, FDS, XS') on the spool",
              symptoms="rectangular current-spool loop of fixed width, stuck spool with quiet P12, limit cycle",
              starts=((10.0, 10 / 1.5), (30.0, 20.0), (90.0, 60.0)), source=_KARNOPP)
register_base("jack_friction", "jack.static_friction", "jack.dynamic_friction",
              law="dry(FSJ, FDJ, XJ') on the ram",
              symptoms="square wave of P12 with sign(v); position hardly moves",
              starts=((480.0, 300.0), (1040.0, 650.0), (2400.0, 1500.0)), source=_KARNOPP)
register_base("viscous_drag", "jack.damping", law="CJ XJ'", symptoms="P12 proportional to v",
              starts=(1000.0, 4000.0, 20e3), source=_PAPER)
register_base("moving_mass", "jack.mass", law="MJ XJ''", symptoms="P12 proportional to acceleration",
              starts=(50.0, 150.0, 200.0), source=_PAPER)
register_base("internal_leakage", "jack.leakage", law="QJ = AJ XJ' + CLK P12",
              symptoms="offset or speed proportional to P12; invisible without load",
              starts=(3e-12, 1.2e-11, 5e-11), revealed_by="a run against a known load", source=_PAPER)

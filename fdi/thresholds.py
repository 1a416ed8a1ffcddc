"""Statistical thresholds of all offline analysis: the limits, gates and margins that decide a verdict.

Each one stands here once, under a name of its own, with the reason for its value or the measurement behind it. They are
grouped by what they decide. Settings of an algorithm (rounds, step widths, grids) are arguments of the function that
uses them; physical limits and the sizes of the faults (Table 2 of the paper) stay beside the physics.

"Noise" in a ratio is the noise floor of the signal: the RMS that the sensors alone would leave of the residual.
"""
from __future__ import annotations

# ---------------------------------------------------------------------------------------------------------------------
# Intervals and residuals, everywhere
# ---------------------------------------------------------------------------------------------------------------------

INTERVAL_95_SD = 1.96
"""Standard deviations on either side of the mean that hold 95 % of a normal distribution."""

RESIDUAL_IS_NOISE = 1.08
"""RMS residual over noise up to which only noise is left; what is above is physics that the model lacks.

The solver's error at the 20 steps a cycle of the last fits is up to 0.5 um beside 2 um of noise (docs/accuracy.md):
3 %. The noise itself is known to 3 % from one repeat (docs/compare.md). 317 of 320 fits of simulated units stayed
below (docs/fdi.md)."""

# ---------------------------------------------------------------------------------------------------------------------
# Bands: when a response has left the healthy range
# ---------------------------------------------------------------------------------------------------------------------

BAND_EVENT_SAMPLES = 3
"""Samples in a row beyond a limit that begin an event; as many back within the limit end it.

One or two samples are a spike of the sensor or the bus, and no such spike may be a false alarm. The speed is a
difference over two samples, so a spike of one sample does not last either."""

BAND_FAULT_CLEARANCE_SD = 4.5
"""Healthy standard deviations by which a fault of Table 2 must move the response where bands judge it.

With 4.5 the limit of MidBand can lie 4 standard deviations from the healthy mean and still be passed by nearly every
unit that has the fault. Some 20 ms of each 5 mm step are left to judge (docs/bands.md)."""

BAND_NEAREST_LIMIT_SD = 4.0
"""Healthy standard deviations; no limit is nearer to the healthy mean than that.

In 1424 simulated healthy units there was no event (docs/bands.md)."""

STEP_FAULT_LEAVES_SD = 2.33, 1.96
"""Standard deviations (MidBand, MaxBand) by which a limit on a step lies below the mean response of clogged units.

One-sided quantiles of a normal distribution: 99 % of units with Kintas 0.25 leave MidBand, 97.5 % of units with Kintas
0.35 leave MaxBand. MaxBand is less strict, as a unit that misses it still has the level MAINTENANCE."""

RAMP_FAULT_MISSED_SHARE = 0.005
"""Share of units with friction of Table 2's size that may stay within the limit of a ramp.

Friction stands out of a ramp by a hundred healthy standard deviations, so bands can be stricter here than on steps."""

RAMP_HEALTHY_SHARE = 0.995
"""Share of healthy units whose ramps stay within the width that is called healthy."""

BAND_UNITS = 416
"""Simulated units, healthy ones and of each fault, that bands are made from: 26 blocks of 16 units.

The mean of 416 units is known to 5 % of their standard deviation, the standard deviation to 3.5 %."""

BAND_UNITS_QUICK = 208, 96
"""Healthy and faulty units where bands are made on the way, in a quarter of the time."""

SECTION_MEASURED_SHARE = 0.8
"""Share of a section's samples that must have been measured for the section to be judged."""

POSITION_MISSING_SHARE = 0.02
"""Largest share of a trace's positions that may be missing and interpolated, for precursors and for learning bands."""

BAND_LARGEST_LOAD = 100.0
"""Known load, N, up to which bands of an unloaded ram hold: 100 N move the ram by 0.6 um, a third of the noise."""

SAME_COMMAND_POSITION = 2e-6
"""Difference, m, up to which two demands are the same: 20 counts of the bus, the least step that a section can have."""

SAME_COMMAND_TIME = 0.004
"""Difference, s, up to which two sections start at the same time: four cycles of the controller."""

SAME_COMMAND_RATE = 0.002
"""Relative difference up to which two ramps have the same rate; the bus rounds the rate of a 1 mm ramp by 0.01 %."""

FAST_SLIP_RATIO = 1.5
"""Slip speed over the one that goes with the static friction; faster slips are noted as low dynamic friction.

The speed of a slip goes with static less dynamic friction, a third of the static one as a rule; 1.5 times that speed is
a dynamic friction of half the static one."""

FRICTION_HIDES_CLOGGING_RATIO = 2.0
"""Spool friction over the healthy one above which a note names friction as the reason why clogging is not judged."""

FLEET_FEWEST_TRACES = 5
"""Healthy traces that bands of a fleet need at least; bands of 5, 8 and 12 traces find 58, 94 and 96 % of 96 units
with Kintas 0.25 (docs/bands.md)."""

FLEET_PRIOR_TRACES = 8.0
"""Traces that the simulated scatter counts for beside the scatter of a fleet's own traces."""

# ---------------------------------------------------------------------------------------------------------------------
# Fault sizes: when a fit is good enough to be believed
# ---------------------------------------------------------------------------------------------------------------------

UNIT_TOLERANCE = 0.015
"""Standard deviation, relative, by which the parameters of healthy units differ (plant/parameters.py)."""

FSS_INTERVAL_FACTOR = 1.1
"""Factor on the interval of FSS that the covariance gives: stick-slip and the solver's step add to it.

Over 320 simulated cases the error was 1.14 standard deviations; with the factor 95.3 % of the intervals hold the true
value, without it 91.3 % (docs/fdi.md)."""

RESIDUAL_WORST = 5.0
"""RMS residual over noise, over all blocks, that a few stops of the ram at the wrong moment may leave.

The typical block (`RESIDUAL_IS_NOISE`) decides; this limit catches a misfit in the 15 % of blocks it leaves out."""

RESIDUAL_HOPELESS = {"xj": 7.0, "p12": 7.0, "xs": 2.0}
"""RMS residual over noise above which a fit does not start again elsewhere: something other than the faults is off.

Of 80 units with Kintas 0.3 and more, five were judged only because such a fit starts again (docs/fdi.md)."""

RESIDUAL_JUDGES_NOTHING = 1.5
"""RMS residual over noise above which a fit says nothing of any size: neither a level nor a suspect is reported."""

FAULT_BLAMED_SHARE = 0.5
"""Share of MidBand; a fit that ends above it is compared with one that starts from a healthy unit."""

ACCEPTABLE_INTERVAL_FACTOR = 1.1
"""Factor on the upper half of the interval that must stay below MidBand for a fault to be acceptable.

A missed fault costs more than an early look. 1.1 times 1.96 standard deviations is 98.4 % on this side: a fault exactly
at MidBand is found in 98 % of simulated tests, 97.5 % less what simulations show otherwise."""

SUSPECT_INTERVAL_FACTOR = 2.0
"""Factor on the 95 % interval of a suspect (jack friction, leakage, null bias ..) that must exclude the healthy range.

There are six suspects in every test, and each would be named by chance in 5 % of them."""

SUSPECT_HEALTHY_TOLERANCES = 4.0
"""Tolerances (`UNIT_TOLERANCE`) within which a suspect counts as healthy."""

SUSPECT_SMALLEST = {"null_bias.current": 1.6e-5, "constant_load.force": 50.0}
"""Null bias, A, and load, N, below which a suspect is not named: 0.2 % of the largest current, 0.3 um of droop."""

MOVING_RAM = 2e-4
"""Range, m, of command and position below which a ram is at rest and shows neither fault: a hundred times the noise."""

# ---------------------------------------------------------------------------------------------------------------------
# Trend: when sizes grow, and what does not belong to the growth
# ---------------------------------------------------------------------------------------------------------------------

TREND_FEWEST_TRACES = 3
"""Traces that make a trend: two points lie on every line."""

TREND_MOST_TRACES = 200
"""Traces that are used, the latest ones; older ones no longer say where the size goes, and 200 take 1.3 s."""

NO_GROWTH_PROBABILITY = 0.05
"""Probability that nothing grows, below which a trend is reported; of 100 healthy units with 25 traces none had one."""

BREAK_PRIOR = 0.01
"""Prior probability that a series holds any one kind of break: an outlier, a step, a repair."""

LAST_OUTLIER_PRIOR = 0.2
"""Prior probability that the last size is out of line: asking for another trace costs little, a false trend much."""

BREAK_MOST = 5
"""Breaks looked for in a series, the strongest first; a series with more of them follows no law."""

BREAK_FEWEST_IN_LINE = 3
"""Sizes that must be in line before another one can be called out of line."""

OFFSET_PRIOR_SD = 0.5
"""Prior standard deviation of a series' offset, in units of (MaxBand - healthy): a fault may be half way at first."""

STEP_PRIOR_SD = 0.5
"""Prior standard deviation of a step in a series, in units of (MaxBand - healthy)."""

INTERVAL_SLOPE_RANGE = 0.15
"""Range of the sizes, in units of (MaxBand - healthy), from which on intervals show how they grow with the size."""

TREND_PATHS = 2000
"""Paths drawn into the future: 50 of them beyond either end of a 95 % interval."""

NEVER_FACTOR = 50.0
"""Times the time seen so far after which a limit that is not reached counts as never reached."""

PACE_SCALE = 0.12
"""Scale of the logarithm of how much faster or slower a fault goes on than the fitted law (Student's t).

Set so that 95 % of the intervals hold the true date in a simulated fleet whose faults follow other laws than the fitted
ones; docs/trend.md scores other units."""

PACE_FREEDOM = 3.0
"""Degrees of freedom of that Student's t: one unit in a hundred changes its pace by more than a factor of two."""

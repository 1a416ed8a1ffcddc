"""Statistical thresholds of all offline analysis: the limits, gates and margins that decide a verdict.

Each one stands here once, under a name of its own, with the reason for its value or the measurement behind it. They are
grouped by what they decide. Settings of an algorithm (rounds, step widths, grids) are arguments of the function that
uses them; physical limits and the sizes of the faults (Table 2 of the paper) stay beside the physics.

"Noise" in a ratio is the noise floor of the signal: the RMS that the sensors alone would leave of the residual.
"""

# ---------------------------------------------------------------------------------------------------------------------
# Intervals and residuals, everywhere
# ---------------------------------------------------------------------------------------------------------------------

# Standard deviations on either side of the mean that hold 95 % of a normal distribution.
INTERVAL_95_SD = 1.96

# Noise floors on either side of zero that a figure shades: noise alone stays within them for 95 % of the time.
NOISE_BAND_RATIO = 2.0

# RMS residual over noise up to which only noise is left; what is above is physics that the model lacks.
#
# The solver's error at the 20 steps a cycle of the last fits is up to 0.5 um beside 2 um of noise (docs/statistics.md):
# 3 %. The noise itself is known to 3 % from one repeat (docs/statistics.md). Of 320 fits of simulated units 317 stayed
# below.
RESIDUAL_IS_NOISE = 1.08

# Share of the noise floor that the solver's error may reach: added in squares, a fifth makes 2 %.
#
# A replay halves its step until it moves by less; an explanation takes finer steps where its error is larger.
SOLVER_ERROR_SHARE = 0.2

# Rate, 1/s, at which a replay's ram is pulled to the measured position.
#
# A free replay adds up every bias without end; this one forgets within 50 ms. White noise of the position comes back as
# 1.005 times itself, an error of speed as 50 ms of it (docs/compare.md).
ANCHOR_RATE = 20.0

# Mean square of whitened residuals up to which a block of 100 cycles counts as fitted; noise alone gives 1 +- 0.14.
#
# A block above it enters the misfit by its logarithm, so that one stop of the ram does not outweigh a whole run.
BLOCK_FITTED_SQUARE = 2.0

# Gain in -2 log likelihood below which a fit has converged: a quarter of a unit of log likelihood.
CONVERGED_GAIN = 0.5

# Gain, as a share of the cost, below which a fit has converged; it decides where the cost is large.
CONVERGED_SHARE = 1e-4

# Sum of squares of whitened residuals, in a run of 13 500 cycles, that a step of 1 % along a flat direction may add.
#
# A direction that a signal shows adds more.
FLAT_DIRECTION_MISFIT = 500.0

# The same for the scale of the flapper's way: below it, the priors of its five parameters know more than the signals.
#
# They add 2.2 for a step of 1 %. A run in which the flapper meets its stops adds 1,100 to 1,500, one in which it does
# not, less than 0.1.
PRIORS_KNOW_MORE_MISFIT = 4.0

# ---------------------------------------------------------------------------------------------------------------------
# Noise: which part of a residual the sensors explain
# ---------------------------------------------------------------------------------------------------------------------

# A window belongs to the noise unless it is larger than this share of all noise windows.
NOISE_WINDOW_CONFIDENCE = 0.995

# Power of a mains line over that of its neighbours from which on it is hum; chance reaches it in one line of 150.
HUM_LINE_RATIO = 5.0

# Gain in -2 log likelihood that a further coefficient of the noise model must bring; Akaike's criterion asks for 2.
NOISE_COEFFICIENT_GAIN = 4.0

# Variance over that of the median block up to which a block holds noise alone; the rest holds a shifted stop.
CALM_BLOCK_RATIO = 1.8

# Noise of a signal over that of the model's sensor above which the signal's own noise counts.
NOISIER_THAN_MODEL = 1.3

# RMS difference of two runs over the noise floors of both, added in squares, up to which noise explains it.
#
# Measured: 1.02 to 1.12 in all signals of runs without spool friction that differ in the seed of their noise (sine of 5
# mm at 2 Hz). Noise that passes through the loop moves the ram, which second differences do not show.
RUN_DIFFERENCE_RATIO = 1.3

# ---------------------------------------------------------------------------------------------------------------------
# Scatter: what healthy units of one design differ by
# ---------------------------------------------------------------------------------------------------------------------

# Tolerances by which a parameter of a healthy unit may be off in a fit; beyond that, physics is missing.
#
# One parameter in two million of a normal distribution is further off.
HEALTHY_TOLERANCES = 5.0

# Tolerances by which a parameter may be off for a comparison to call the error scatter.
SCATTER_TOLERANCES = 3.0

# Residual over noise from which on samples count less in the refit of scatter: single stops of the ram.
SCATTER_LARGE_RESIDUAL = 6.0

# RMS residual over noise up to which scatter within the tolerances is the whole explanation of an error.
#
# More than `RESIDUAL_IS_NOISE`, as the refit takes two steps only.
RESIDUAL_IS_SCATTER = 1.15

# Share by which a friction level may be off; a stop that depends on less is undecided.
#
# No simulator, no oil and no seal is known better than that.
FRICTION_UNCERTAINTY = 1e-3

# ---------------------------------------------------------------------------------------------------------------------
# Effects: when missing physics is found. Gains are in -2 log likelihood.
# ---------------------------------------------------------------------------------------------------------------------

# Gain with which an effect is seen: the charge for choosing among all candidates, and ten more.
GAIN_SEEN = 30.0

# Gain, on the run and on its repeat, with which an effect is named although the model is at the floor without it.
GAIN_CONVINCES = 60.0

# Gain up to which an effect may only make up for what the base's own fit has left; the base is fitted again then.
GAIN_DOUBTFUL = 500.0

# Difference below which two explanations are equally good: odds of 1000 to 1.
GAIN_TIE = 14.0

# Cosine between what two effects change, the tolerances taken out, from which they count as look-alikes. Of the pairs
# of the shipped catalogue on preflight eight have more: coil lag and transport delay 0.98, a constant load and an
# asymmetric friction 0.99, clogging and spool friction 0.73.
LOOKS_ALIKE = 0.7

# Expected gain of an effect below which no full fit is made.
GAIN_WORTH_A_FIT = 20.0

# Excess error over that before, below which an effect is a part of the explanation.
ERROR_PARTLY_EXPLAINED = 0.8

# Times its error without an effect, or the noise floor, beyond which a signal is worse with it: it is then no part.
#
# A wrong motor speed was called 1067 N s/m of damping: the speed's error fell from 37 floors to 2, the position's rose
# from 1 to 9.
SIGNAL_SPOILED = 2.0

# Share of the excess cost that an effect must remove for another one to be looked for on top of it.
FURTHER_EFFECT_SHARE = 0.1

# RMS residual over noise up to which a fit with one effect may only have missed a stop, in a local minimum.
RESIDUAL_IS_NEAR_NOISE = 1.5

# RMS residual over noise in the typical block of a held-out run, up to which an explanation holds there.
#
# More than `RESIDUAL_IS_NOISE`, as no parameter is fitted to that run.
RESIDUAL_HELD_OUT = 1.2

# Share of a held-out run that may be undecided (`FRICTION_UNCERTAINTY`); the rest of the run then decides.
#
# Compressible oil of 6e8 Pa, replayed at its true values with steps of 1 us: 1.5 and 2.8 noise floors are left of a
# held-out run (XJ, P12), and 1.0 of the 52 % of it that are decided.
HELD_OUT_UNDECIDED_SHARE = 0.7

# Gain on one simulated run from which on an effect counts as detectable.
#
# More than `GAIN_CONVINCES`, as a fit to a real run also makes up for a part of what the simulated fit leaves. Chosen
# after the first hidden effects: a load of 3.6 N gained 65 and was found.
GAIN_DETECTED = 100.0

# Mean square of whitened residuals from which on a last fit is tried again from a healthy unit.
WHITE_SQUARE_POOR = 1.02

# Share of healthy units whose tolerances are further off, from which on a last fit is tried again and an effect named.
#
# All together, by the chi-squared distribution: a mean square of 2.5 in 16 tolerances, of 4.8 in four. A fit that had
# ended far off in a valley had 3.4 in 16, left only noise and gave a size half the true one; from a healthy unit it
# ended at 0.3, and its cost fell by 48. Or the furthest one: 4.1 standard deviations of 16, 3.7 of four. The stiffness
# of a joint whose flexspline had softened by 45 % was at 4.5, among eight, and nothing else was left to see. Each
# of the two has this share, so that both together call at most one healthy unit in 640 far.
TOLERANCES_FAR_SHARE = 0.00078

# Misfit of the wrong explanation, fitted to the prediction of the other one, from which on a test discriminates.
MISFIT_DISCRIMINATES = 50.0

# Simulated runs in which nothing is missing, for the p-value; beyond their reach a Bonferroni bound holds.
NULL_DRAWS = 4000

# Factor on the standard deviation of an effect's parameter at the end of a fit, which stops in a rough valley.
#
# Measured with `EFFECT_SYSTEMATIC_SD` on cases of another simulator with 1.5 % scatter; without them one interval in
# four misses the true value.
EFFECT_INTERVAL_FACTOR = 1.6

# Standard deviation, as a share of an effect's size, that the solver's step and unfitted parameters add.
EFFECT_SYSTEMATIC_SD = 0.01

# Tolerances by which a fitted parameter may be off before it is reported as suspicious.
SUSPICIOUS_TOLERANCES = 3.0

# RMS of Cor against the model's firmware, in units of what rounding leaves, above which the firmware differs.
#
# Rounding of what the bus and the file hold gives 1; columns that are rounded twice, 1.9.
FIRMWARE_DIFFERS = 3.0

# Share of the controller's difference that an effect of the firmware may leave and still be named. A command that is
# not what the controller received leaves half with the best of them.
FIRMWARE_EXPLAINED = 0.2

# Least noise, over that of the sensor, that a recording is taken to have: a simulated one may have none, and then the
# error of the solver would be the only thing left to explain.
#
# With a tenth a lag of 7 us was named in healthy units of another simulator in steps of 5 us. With a quarter they are
# healthy, and ten effects of an electromechanical actuator, in its simulation without noise, are all named alone.
QUIETEST_NOISE = 0.25

# Steps of a position, over the noise of its sensor, that are no effect of the transducer: the noise hides them.
COMB_HIDDEN = 0.125

# Steps of a recorded position, m, above which they are none of the bus, whose counts are 1e-7 m.
FINEST_COMB = 2.5e-7

# Share of the samples that must differ by half a step of XJ at most for the recorder to have rounded it.
#
# All do if the controller reads the position finer than the recording holds it; a firmware that differs leaves more.
ROUNDED_SHARE = 0.95

# Missing force, flow or current over what sensor noise alone gives, from which on its pattern is shown.
PATTERN_VISIBLE_RATIO = 1.3

# Share of the missing force, flow or current that a curve must explain to be reported.
PATTERN_EXPLAINED_SHARE = 0.25

# ---------------------------------------------------------------------------------------------------------------------
# Bands: when a response has left the healthy range
# ---------------------------------------------------------------------------------------------------------------------

# Samples in a row beyond a limit that begin an event; as many back within the limit end it.
#
# One or two samples are a spike of the sensor or the bus, and no such spike may be a false alarm. The speed is a
# difference over two samples, so a spike of one sample does not last either.
BAND_EVENT_SAMPLES = 3

# Healthy standard deviations by which a fault of Table 2 must move the response where bands judge it.
#
# With 4.5 the limit of MidBand can lie 4 standard deviations from the healthy mean and still be passed by nearly every
# unit that has the fault. Some 20 ms of each 5 mm step are left to judge (docs/statistics.md).
BAND_FAULT_CLEARANCE_SD = 4.5

# Healthy standard deviations; no limit is nearer to the healthy mean than that.
#
# In 1424 simulated healthy units there was no event (docs/statistics.md).
BAND_NEAREST_LIMIT_SD = 4.0

# Standard deviations (MidBand, MaxBand) by which a limit on a step lies below the mean response of clogged units.
#
# One-sided quantiles of a normal distribution: 99 % of units with Kintas 0.25 leave MidBand, 97.5 % of units with
# Kintas 0.35 leave MaxBand. MaxBand is less strict, as a unit that misses it still has the level MAINTENANCE.
STEP_FAULT_LEAVES_SD = 2.33, 1.96

# Share of units with friction of Table 2's size that may stay within the limit of a ramp.
#
# Friction stands out of a ramp by a hundred healthy standard deviations, so bands can be stricter here than on steps.
RAMP_FAULT_MISSED_SHARE = 0.005

# Share of healthy units whose ramps stay within the width that is called healthy.
RAMP_HEALTHY_SHARE = 0.995

# Simulated units, healthy ones and of each fault, that bands are made from: 26 blocks of 16 units.
#
# The mean of 416 units is known to 5 % of their standard deviation, the standard deviation to 3.5 %.
BAND_UNITS = 416

# Healthy and faulty units where bands are made on the way, in a quarter of the time.
BAND_UNITS_QUICK = 208, 96

# Share of a section's samples that must have been measured for the section to be judged.
SECTION_MEASURED_SHARE = 0.8

# Largest share of a trace's positions that may be missing and interpolated, for precursors and for learning bands.
POSITION_MISSING_SHARE = 0.02

# Known load, in parts of the largest one of the plant, up to which bands of an unloaded plant hold: of the EHA 100 N,
# which move the ram by 0.6 um, a third of the noise.
BAND_LARGEST_LOAD = 1e-4

# Difference, m, up to which two demands are the same: 20 counts of the bus, the least step that a section can have.
SAME_COMMAND_POSITION = 2e-6

# Difference, s, up to which two sections start at the same time: four cycles of the controller.
SAME_COMMAND_TIME = 0.004

# Relative difference up to which two ramps have the same rate; the bus rounds the rate of a 1 mm ramp by 0.01 %.
SAME_COMMAND_RATE = 0.002

# Healthy traces that bands of a fleet need at least; bands of 5, 8 and 12 traces find 58, 94 and 96 % of 96 units with
# Kintas 0.25 (docs/statistics.md).
FLEET_FEWEST_TRACES = 5

# Traces that the simulated scatter counts for beside the scatter of a fleet's own traces.
FLEET_PRIOR_TRACES = 8.0

# ---------------------------------------------------------------------------------------------------------------------
# Fault sizes: when a fit is good enough to be believed
# ---------------------------------------------------------------------------------------------------------------------

# Standard deviation, relative, by which the parameters of healthy units differ (plant/parameters.py).
UNIT_TOLERANCE = 0.015

# RMS residual over noise, over all blocks, that a few stops of the ram at the wrong moment may leave.
#
# The typical block (`RESIDUAL_IS_NOISE`) decides; this limit catches a misfit in the 15 % of blocks it leaves out. A
# fit with other effects has been begun elsewhere too and must do better (`FITTED_RUN_WORST`).
RESIDUAL_WORST = 5.0

# RMS residual over noise above which a fit does not start again elsewhere: something other than the faults is off.
#
# Of 80 units with Kintas 0.3 and more, five were judged only because such a fit starts again.
RESIDUAL_HOPELESS = 7.0

# The same of the position of a valve, which follows the drive without a load.
RESIDUAL_HOPELESS_VALVE = 2.0

# Error of the best explanation over the noise floor from which the recording may be of another plant or in other units.
#
# Recordings of other plants left more than 10,000 floors, one in radians of a plant in degrees 49; a unit with an
# effect that the catalogue lacks left 5.
RESIDUAL_FOREIGN = 30.0

# RMS residual over noise above which a fit says nothing of any size: neither a level nor a suspect is reported.
RESIDUAL_JUDGES_NOTHING = 1.5

# Correlation of two estimated sizes from which the faults may be one group that a trace does not tell apart.
GROUP_CORRELATION = 0.5

# Prior standard deviation of a size that is fitted without a logarithm, in MidBands: it may be any.
LINEAR_FAULT_SPREAD = 10.0

# Half of the narrowest interval of a size, in MidBands: stops of spool and ram that a replay makes or misses move its
# best value by up to that, which the covariance at one point does not see.
NARROWEST_SHARE = 0.03

# Share of MidBand; a fit that ends above it is compared with one that starts from a healthy unit.
FAULT_BLAMED_SHARE = 0.5

# Share of units without a fault in which one of a list of more than two may be reported.
ABSENT_FAULT_SHARE = 0.01

# Factor on the upper half of the interval that must stay below MidBand for a fault to be acceptable.
#
# A missed fault costs more than an early look. 1.1 times 1.96 standard deviations is 98.4 % on this side: a fault
# exactly at MidBand is found in 98 % of simulated tests, 97.5 % less what simulations show otherwise.
ACCEPTABLE_INTERVAL_FACTOR = 1.1

# Factor on the 95 % interval of a suspect (jack friction, leakage, null bias ..) that must exclude the healthy range.
#
# There are six suspects in every test, and each would be named by chance in 5 % of them.
SUSPECT_INTERVAL_FACTOR = 2.0

# Tolerances (`UNIT_TOLERANCE`) within which a suspect counts as healthy.
SUSPECT_HEALTHY_TOLERANCES = 4.0

# Cosine between what a fault and a suspect change, from which one may stand for the other: a blocked nozzle and a null
# bias have 1.00.
SUSPECT_COSINE = 0.95

# Null bias, A, and load, N, below which a suspect is not named: 0.2 % of the largest current, 0.3 um of droop.
SUSPECT_SMALLEST = {"null_bias.current": 1.6e-5, "constant_load.force": 50.0}

# Probability below which an explanation by another effect does not count in the sizes of the valve faults.
#
# It would move the end of a 95 % interval by less than the ends are known.
WEIGHT_COUNTS = 0.02

# Range, m, of command and position below which a ram is at rest and shows neither fault: a hundred times the noise.
MOVING_RAM = 2e-4

# ---------------------------------------------------------------------------------------------------------------------
# Trend: when sizes grow, and what does not belong to the growth
# ---------------------------------------------------------------------------------------------------------------------

# Traces that make a trend: two points lie on every line.
TREND_FEWEST_TRACES = 3

# Traces that are used, the latest ones; older ones no longer say where the size goes, and 200 take 1.3 s.
TREND_MOST_TRACES = 200

# Probability that nothing grows, below which a trend is reported; of 100 healthy units with 25 traces none had one.
NO_GROWTH_PROBABILITY = 0.05

# Prior probability that a series holds any one kind of break: an outlier, a step, a repair.
BREAK_PRIOR = 0.01

# Prior probability that the last size is out of line: asking for another trace costs little, a false trend much.
LAST_OUTLIER_PRIOR = 0.2

# Breaks looked for in a series, the strongest first; a series with more of them follows no law.
BREAK_MOST = 5

# Sizes that must be in line before another one can be called out of line.
BREAK_FEWEST_IN_LINE = 3

# Prior standard deviation of a series' offset, in units of (MaxBand - healthy): a fault may be half way at first.
OFFSET_PRIOR_SD = 0.5

# Prior standard deviation of a step in a series, in units of (MaxBand - healthy).
STEP_PRIOR_SD = 0.5

# Range of the sizes, in units of (MaxBand - healthy), from which on intervals show how they grow with the size.
INTERVAL_SLOPE_RANGE = 0.15

# Paths drawn into the future: 50 of them beyond either end of a 95 % interval.
TREND_PATHS = 2000

# Times the time seen so far after which a limit that is not reached counts as never reached.
NEVER_FACTOR = 50.0

# Scale of the logarithm of how much faster or slower a fault goes on than the fitted law (Student's t).
#
# Set so that 95 % of the intervals hold the true date in a simulated fleet whose faults follow other laws than the
# fitted ones; docs/statistics.md scores other units.
PACE_SCALE = 0.12

# Degrees of freedom of that Student's t: one unit in a hundred changes its pace by more than a factor of two.
PACE_FREEDOM = 3.0

# ---------------------------------------------------------------------------------------------------------------------
# Comparison: when a residual is an error of the model
# ---------------------------------------------------------------------------------------------------------------------

# RMS residual over noise, to which three standard deviations of the estimate are added, up to which a signal is noise.
#
# The floor is known to 3 % from one repeat; without repeats the model's sensor noise may be a few per cent too small.
SIGNAL_ERROR_RATIO = 1.1

# Standard deviations by which a single section may be above the floor; a trace has dozens of sections.
SECTION_ERROR_SD = 5.0

# Mean square of a window of 0.1 s over that of the floor, from which on a run is off, and up to which another run fits.
#
# An error of the model is in both: they differ by less than that even where noise is coloured.
RUN_IS_OFF, RUN_FITS = 4.0, 2.0

# Share of rows in which a run is off and its repeat is not, from which on that is no stop of a hair more or less: the
# two runs differ. In signals as a whole: RMS of one run, over the floor and that of each repeat.
OFF_ALONE_SHARE, OFF_ALONE_RATIO = 0.1, 2.0

# RMS residual over floor up to which a block of the actuator agrees: the floor of a balance is known less well than a
# signal's.
BLOCK_ERROR_RATIO = 1.3

# RMS residual over noise from which on an error is one even if the floor is only a lower bound.
LOWER_BOUND_ERROR_RATIO = 3.0

# Solver error over floor above which a comparison cannot tell: half the floor adds 12 % to the residual.
SOLVER_HIDES_RATIO = 0.5

# Share of rows that may hang on a thousandth of a friction level and be left out of the judgement.
UNDECIDED_SHARE = 0.4

# Misfit that moving the current by some cycles must leave, of that before, for the columns to be out of step.
LAG_MISFIT_RATIO = 0.5

# Difference between repeats over the floor above which a note says that the error itself does not repeat.
REPEAT_DIFFERENCE_RATIO = 1.5

# Noise floor from repeats over the noise of the model's sensors above which the floor holds more than noise.
#
# The floors of 11 pairs of true repeats were at most 1.14 times the sensors' noise, at errors of up to 49 times that
# noise. A repeat from another unit gave 6 to 100.
REPEAT_FLOOR_RATIO = 3.0

# Twice the log likelihood below which an error of the flow and one of the sensor describe a residual equally well.
SHAPE_TIE_GAIN = 10.0

# Noise of the sensed position from sample to sample, over its level, above which the sensor is at fault in a tie.
NOISY_SENSOR_RATIO = 1.3

# RMS residual of XS over noise below which the spool is as the model says.
SPOOL_FITS_RATIO = 1.1

# Squared residual over squared floor, less 1, below which flow and sensor are not told apart.
BLOCK_EXCESS_LEAST = 0.1

# Misfit of the controller's block with a lag, over that without, below which the lag is believed.
CONTROLLER_LAG_RATIO = 0.1

# Error of the controller's block over the resolution of the file or bus: rounding alone does not reach 3.
CONTROLLER_ERROR_RATIO = 3.0

# Share of the excess error that a condition must hold to be named.
CONDITION_SHARE = 0.6

# Density of the excess error under a condition over the average density, at least.
CONDITION_DENSITY = 1.8

# Mean squared residual over squared floor, less 1, below which no condition is looked for.
#
# The floor itself may be off by that.
CONDITION_EXCESS_LEAST = 0.05

# Probability with which white noise stays within the band of a residual's test.
RESIDUAL_TEST_CONFIDENCE = 0.99

# Share by which the ram moves more or less than the flow into it predicts, from which on the model may be that of
# another actuator: tolerances of 1.5 % of area and flow gain do not add up to it.
FLOW_GAIN_FAR = 0.1

# Share of the residual's variance that a dependence on a quantity must hold to be reported.
DEPENDENCE_SHARE = 0.05

# ---------------------------------------------------------------------------------------------------------------------
# Identification of a user's actuator
# ---------------------------------------------------------------------------------------------------------------------

# Factor on the standard deviation of an identified parameter: a fit ends somewhere in a rough valley.
#
# That of `EFFECT_INTERVAL_FACTOR`; with `IDENTIFIED_SYSTEMATIC_SD` it is checked by 20 trials (docs/statistics.md).
IDENTIFIED_INTERVAL_FACTOR = 1.6

# Standard deviation, relative, that the solver's step adds to an identified parameter.
IDENTIFIED_SYSTEMATIC_SD = 0.001

# The same for the pilot stage's flow gain.
#
# All that the flapper's way goes with may be scaled by so much. Only the few samples in which the flapper is at its
# stop show it, and a stop of the spool that moves by a sample hides them. In 30 trials (seeds 200, 208, 305 to 334) the
# error was 0.13 % (RMS); with `IDENTIFIED_SYSTEMATIC_SD` three intervals missed.
PILOT_FLOW_SYSTEMATIC_SD = 0.0015

# The same for the ram's static friction, which decides single stops: the fit may make one and miss the next.
#
# Its error was 0.4, 0.5, 0.6, 0.8 and 4.0 % in the first five trials.
STATIC_FRICTION_SYSTEMATIC_SD = 0.02

# RMS residual over noise of a fitted run, over all its blocks, above which an identification is only a part, and a
# diagnosis beside other effects explains nothing: a search that has tried other starts ends in a local minimum there.
#
# The typical block hides a few stops of the ram at the wrong moment; in a run that was fitted they mean that the fit
# ended in a local minimum. In trials with fresh seeds the two fits with 2.5 and 2.8 had frictions that were 5 to 13 %
# off; the others had at most 1.1.
FITTED_RUN_WORST = 1.3

# Half the interval over half the range of the data sheet, up to which a parameter is identifiable from the runs.
IDENTIFIABLE_SHARE = 0.2

# ---------------------------------------------------------------------------------------------------------------------
# The guess of an import map
# ---------------------------------------------------------------------------------------------------------------------

# Correlation of Com and XJ from which the guess computes the scale of one in counts from the other. A slow ram, or a
# command beyond its stroke, lowers it to 0.66 in a test; columns that are not Com and XJ are usually below.
LEAST_SCALING_CORRELATION = 0.5

# Correlation of a drive and a speed from which the guess takes their columns for those of an open loop.
#
# Half of what a drive without end stops and saturation would have: a ram waits at its stops.
LEAST_SPEED_CORRELATION = 0.5

# Noise of a reading's step over the noise of the nominal sensor, from which the guess writes the step into the map: a
# smaller one changes the noise floor by less than 0.5 %.
LEAST_QUANTUM_NOISE = 0.1

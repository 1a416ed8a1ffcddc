"""Effects on the way of the current, from the bus through driver, line and coil to the armature, in this order."""

from collections import namedtuple
from math import inf, pi, sin
from typing import Any

from plant.effects import Held, Lag, Quantity, clip, effect, play

# the current of this cycle and of the five before
Past = namedtuple("Past", "now one two three four five", defaults=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


@effect("current", {  # How much later than it should the current acts, in cycles.
    "cycles": Quantity("1", low=0, high=5, typical="0.2-3 cycles, fractions too"),
}, law="i(t) = i(t - n T), n = cycles", symptoms="phase without attenuation", memory=Past, starts=(0.3, 1.0, 3.0),
    confused_with=("sensor_lag", "coil_lag"),
    source="synchronous buses: an answer that misses its SYNC acts a cycle later")
def transport_delay(x: float, m: Past, s: Any, u: Any, p: Any) -> tuple[float, Past]:
    """A bus, a gateway or a slow driver: the current comes later.

    A step in which the current changes gets the mean of both, so that a fit sees a slope between whole steps.
    """
    new = u.phase == 0.0
    one, two = m.now if new else m.one, m.one if new else m.two
    three, four, five = m.two if new else m.three, m.three if new else m.four, m.four if new else m.five
    rate = 1.0 / u.h
    late = (p.transport_delay.cycles * p.controller.period - u.phase) * rate  # steps until this cycle's current acts
    cycle = p.controller.period * rate
    a, b, c = _share(late), _share(late - cycle), _share(late - 2.0 * cycle)
    d, e = _share(late - 3.0 * cycle), _share(late - 4.0 * cycle)
    y = x * (1.0 - a) + one * (a - b) + two * (b - c) + three * (c - d) + four * (d - e) + five * e
    return y, Past(x, one, two, three, four, five)


def _share(steps: float) -> float:
    """The part of a step in which the older current still acts, the newer being `steps` away; whole ones are whole."""
    steps = steps if steps > 1e-9 else 0.0
    return steps if steps < 1.0 - 1e-9 else 1.0


# what four equal lags in series show
Cascade = namedtuple("Cascade", "one two three four", defaults=(0.0, 0.0, 0.0, 0.0))


@effect("current", {  # Delay between drive and flow.
    "time": Quantity("s", low=0, high=0.5, typical="1-30 ms"),
}, law="four lags in series: (tau/4 y' + y)^4 = x, tau = time; a delay of tau, spread tau/2",
    symptoms="the ram starts and stops late, without another speed", memory=Cascade, starts=(3e-3, 1e-2, 3e-2),
    confused_with=("transport_delay", "sensor_lag", "coil_lag"), searched_in=("ehs",),
    source="lines and hoses between pump and ram; Erlang's chain for a delay")
def flow_delay(x: float, m: Cascade, s: Any, u: Any, p: Any) -> tuple[float, Cascade]:
    """The flow follows its drive later: lines, hoses, and a pump that has to fill (implicit; no delay: exactly x)."""
    part = 0.25 * p.flow_delay.time
    keep = part / (part + u.h)
    one = x + keep * (m.one - x)
    two = one + keep * (m.two - one)
    three = two + keep * (m.three - two)
    four = three + keep * (m.four - three)
    return four, Cascade(one, two, three, four)


# the side that the valve gives the flow to, and since when
Switched = namedtuple("Switched", "side since", defaults=(0.0, 0.0))


@effect("current", {  # How long a directional valve takes from one side to the other.
    "time": Quantity("s", low=0, high=1, typical="10-100 ms"),
}, law="no flow for the time after a change of sign of the drive",
    symptoms="a reversal costs the same time whatever the speed", memory=Switched, starts=(0.02, 0.05, 0.1),
    searched_in=("ehs",), source="data sheets of directional valves: switching times")
def valve_switching(x: float, m: Switched, s: Any, u: Any, p: Any) -> tuple[float, Switched]:
    """The valve's spool travels from one side to the other: the flow waits. The first side is taken at once.

    A step in which the time ends gets the mean, so that a fit sees a slope between whole steps.
    """
    side = 1.0 if x > 0.0 else -1.0 if x < 0.0 else m.side
    reverses = side * m.side < 0.0
    since = 0.0 if reverses else m.since + u.h if m.side * side > 0.0 else p.valve_switching.time
    return x * (1.0 - _share((p.valve_switching.time - since) / u.h)), Switched(side, since)


@effect("current", {  # What the driver's limit is short of Imax, as a fraction of it.
    "loss": Quantity("1", low=0, high=1, typical="0.05-0.4"),
}, law="|i| <= Imax (1 - loss)", symptoms="exactly zero residual while below the limit", starts=(0.05, 0.2, 0.4),
    confused_with=("supply_droop",), source="a current source short of voltage")
def current_limit(x: float, s: Any, u: Any, p: Any) -> float:
    """The valve driver clips, though the firmware asks for more."""
    loss = p.current_limit.loss
    return clip(x, p.controller.current_limit * (1.0 - loss) if loss > 0.0 else inf)


@effect("current", {  # Electrical noise on the current line.
    "white": Quantity("A rms", low=0, high=20),
    "hum": Quantity("A", low=0, high=20, typical="amplitude"),
    "frequency": Quantity("Hz", low=0, high=1e6),
}, off={"frequency": 400.0}, law="i = i + white n_k + hum sin(2 pi f t), n_k new every cycle",
    symptoms="the current the coil feels differs from the one sent; a line at f in what it drives", disturbance=True,
    source="the source paper: disturbances of the current line")
def current_noise(x: float, s: Any, u: Any, p: Any) -> float:
    """Aircraft supply hum and white noise couple into the current line."""
    g = p.current_noise
    return x + g.white * u.noise + g.hum * sin(2.0 * pi * g.frequency * u.t)


@effect("current", {  # First-order lag of the coil.
    "time": Quantity("s", low=0, high=0.1, typical="0.3-3 ms"),
}, law="tau i' + i = i_driver", symptoms="attenuates above 1/(2 pi tau); a delay does not", memory=Lag,
    starts=(0.3e-3, 1e-3, 3e-3), confused_with=("transport_delay", "sensor_lag"),
    source="inductance and resistance of the coil, Merritt 1967")
def coil_lag(x: float, m: Lag, s: Any, u: Any, p: Any) -> tuple[float, Lag]:
    """The coil's inductance: the mean current over a step in which the driver's is constant (no lag: exactly it)."""
    two = 2.0 * p.coil_lag.time
    whole = 1.0 / (two + u.h)
    keep = (two - u.h) * whole
    before = m.behind - (x - m.last)
    return x + two * whole * before, Lag((keep if keep > 0.0 else 0.0) * before, x)


@effect("current", {  # Current offset.
    "current": Quantity("A", low=-20, high=20, typical="0.2-4 % of Imax"),
}, law="i = i + i0", symptoms="constant error at rest, i0 over the gain, without a force",
    starts=(3e-5, -3e-5, 3e-4, -3e-4), confused_with=("constant_load", "friction_asymmetry"),
    source="null shift of servovalves, SAE ARP490")
def null_bias(x: float, s: Any, u: Any, p: Any) -> float:
    """The valve's null is not at zero current."""
    return x + p.null_bias.current


@effect("current", {  # Width of the loop, current up against current down.
    "width": Quantity("A", low=0, high=20, typical="1-5 % of Imax"),
}, law="i = play(i, width)", symptoms="loop in current against what it drives, rate free; no part of it sticks",
    memory=Held, starts=(8e-5, 2e-4, 4e-4), source="play operator, Krasnosel'skii and Pokrovskii 1989")
def torque_motor_hysteresis(x: float, m: Held, s: Any, u: Any, p: Any) -> tuple[float, Held]:
    """Magnetic hysteresis and friction of the armature: after a reversal the torque waits for the play."""
    held = play(x, m.held, 0.5 * p.torque_motor_hysteresis.width)
    return held, Held(held)

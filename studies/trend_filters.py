"""Compare `rig trend` with two library filters on the same units.

    pip install progpy filterpy; OPENBLAS_NUM_THREADS=1 python -m studies.trend_filters [COUNT]

Both filters estimate the state (size x, rate a, curvature c) with x' = a + c x. They take each interval as the noise of
its trace, and let a and c wander. Sizes are scaled to 1 at MaxBand, time to 100 days.
"""

import time
import warnings
from collections.abc import Callable

import numpy as np

from studies.command import start_parser
from studies.prognosis import LAWS, Unit, predict_unit, simulate_unit

PARTICLES, PARTS = 2000, (0.3, 0.5, 0.7, 0.9)
START, SPREAD = np.log(0.2), 1.5  # of the logarithm of a, and of c


def scale_sizes(u: Unit, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times in 100 days; sizes, 0 healthy and 1 at MaxBand; their standard deviations."""
    span = u.fault.maintenance - u.fault.healthy
    value, low, high = np.array(u.sizes[:n]).T
    return u.t[:n] / 100, (value - u.fault.healthy) / span, np.maximum(high - value, value - low) / 1.96 / span


def time_to_limit(x: np.ndarray, a: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Days until the size x reaches 1 with rate a and curvature c; infinite if it never does."""
    c = np.where(np.abs(c) < 1e-9, 1e-9, c)
    with np.errstate(all="ignore"):
        t = np.where(x >= 1.0, 0.0, np.log((a + c) / (a + c * x)) / c)
    return 100 * np.where(np.isfinite(t) & (t >= 0.0), t, np.inf)


def advance_size(x: np.ndarray, a: np.ndarray, c: np.ndarray, dt: float) -> np.ndarray:
    """The size after a time dt, in 100 days."""
    c = np.where(np.abs(c) < 1e-9, 1e-9, np.clip(c, -8, 8))
    return x * np.exp(c * dt) + a * np.expm1(c * dt) / c


def predict_by_rig_trend(u: Unit, n: int) -> np.ndarray:
    """Remaining days to MaxBand by `rig trend`."""
    return predict_unit(u, n).most


def predict_by_unscented_filter(u: Unit, n: int) -> np.ndarray:
    """Remaining days to MaxBand by the unscented Kalman filter of filterpy, state (x, log a, c)."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    t, y, s = scale_sizes(u, n)

    def rate(log_a: np.ndarray) -> np.ndarray:
        return np.exp(np.clip(log_a, -12, 6))

    def step(x: np.ndarray, dt: float) -> np.ndarray:
        return np.array([advance_size(x[0], rate(x[1]), x[2], dt), x[1], x[2]])

    f = UnscentedKalmanFilter(3, 1, 1.0, lambda x: x[:1], step, MerweScaledSigmaPoints(3, 0.5, 2.0, 0.0))
    f.x, f.P = np.array([y[0], START, 0.0]), np.diag([s[0] ** 2, SPREAD ** 2, SPREAD ** 2])
    f.Q = np.diag([1e-5, 0.02, 0.02])
    for k in range(1, n):
        f.predict(dt=t[k] - t[k - 1])
        f.P = (f.P + f.P.T) / 2 + 1e-10 * np.eye(3)
        f.update(y[k:k + 1], R=np.array([[s[k] ** 2]]))
        f.P = (f.P + f.P.T) / 2 + 1e-10 * np.eye(3)
    x, log_a, c = np.random.default_rng(1).multivariate_normal(f.x, f.P, PARTICLES).T
    return time_to_limit(x, rate(log_a), np.clip(c, -8, 8))


def predict_by_particles(u: Unit, n: int) -> np.ndarray:
    """Remaining days to MaxBand by the particle filter of ProgPy, state (x, a, c)."""
    from progpy import PrognosticsModel
    from progpy.state_estimators import ParticleFilter
    from progpy.uncertain_data import UnweightedSamples

    class Growth(PrognosticsModel):
        inputs, states, outputs, events, is_vectorized = [], ["x", "a", "c"], ["y"], ["end"], True
        default_parameters = {  # noqa: RUF012
            "x0": {"x": 0.0, "a": 0.2, "c": 0.0}, "process_noise": {"x": 0.05, "a": 0.5, "c": 1.5},
            "measurement_noise": {"y": 0.05}}

        def next_state(self, x, u, dt):
            a = np.maximum(x["a"], 1e-6)
            return self.StateContainer({"x": advance_size(x["x"], a, x["c"], dt), "a": a, "c": x["c"]})

        def output(self, x):
            return self.OutputContainer({"y": x["x"]})

        def threshold_met(self, x):
            return {"end": x["x"] >= 1}

    t, y, s = scale_sizes(u, n)
    rng, model = np.random.default_rng(1), Growth()
    np.random.seed(1)
    first = zip(y[0] + s[0] * rng.standard_normal(PARTICLES), np.exp(START + SPREAD * rng.standard_normal(PARTICLES)),
                SPREAD * rng.standard_normal(PARTICLES), strict=True)
    f = ParticleFilter(model, UnweightedSamples([model.StateContainer({"x": x, "a": a, "c": c}) for x, a, c in first]),
                       num_particles=PARTICLES, t0=t[0] - 1e-9, measurement_noise={"y": float(s.mean())})
    for k in range(1, n):
        f.estimate(t[k], model.InputContainer({}), model.OutputContainer({"y": y[k]}), dt=t[k] - t[k - 1])
    x, a, c = (np.array(f.particles[name]) for name in "xac")
    return time_to_limit(x, np.maximum(a, 1e-6), c)


def format_score(name: str, method: Callable[[Unit, int], np.ndarray],
         units: list[Unit]) -> str:
    """The scores of a method as a row of the table."""
    rows = []
    for u in units:
        end = u.time_of_size(u.fault.maintenance)
        for part in PARTS:
            n = int(np.searchsorted(u.t, u.onset + part * (end - u.onset)))
            if n < 3:
                continue
            start = time.process_time()
            times, true = method(u, n), end - u.t[n - 1]
            duration = time.process_time() - start
            low, middle, high = np.quantile(times, [0.025, 0.5, 0.975], method="nearest")
            rows.append((low <= true <= high, np.mean(np.abs(times - true) <= 0.2 * true) >= 0.5,
                         high / true, abs(middle - true) / true, duration))
    is_covered, within, high, error, duration = np.array(rows, dtype=float).T
    return (f"| {name} | {int(is_covered.sum())}/{len(is_covered)} = {100 * is_covered.mean():.1f} % "
            f"| {within.mean():.2f} | {np.median(high):.2f} | {np.median(error):.2f} "
            f"| {1e3 * duration.mean():.0f} ms |")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    parser = start_parser("studies.trend_filters", __doc__)
    parser.add_argument("count", type=int, nargs="?", default=5, help="units of each law of growth (default 5)")
    count = parser.parse_args().count
    fleet_units = [simulate_unit(law, 5000 + 100 * i + k)
                   for i, law in enumerate(LAWS) for k in range(count)]
    print("| method | 95 % to MaxBand | within 20 % | upper end / true | error of the median | a prediction |")
    print("|---|---|---|---|---|---|")
    for method in (predict_by_rig_trend, predict_by_unscented_filter, predict_by_particles):
        print(format_score(method.__name__, method, fleet_units), flush=True)

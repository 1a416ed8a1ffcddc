"""The jack behind its metering edges once more, explicit at 0.5 us, with the effects that the plant solves implicitly.

Shares neither code nor scheme with plant/: the orifice law by bisection, compressible oil and LuGre's bristles as
states of their own. The spool follows a given path.
"""

from collections.abc import Mapping
from typing import Any

import numba
import numpy as np


@numba.njit
def _excess(pressure: float, spool: float, flow: float, p: Any) -> float:
    """Flow that the edges give beyond what the jack takes, m3/s; falls with `pressure`."""
    w = spool
    if spool != 0.0 and p[8] > 0.0:
        left = 1.0 - (pressure if spool > 0.0 else -pressure) / p[4]
        w = spool * (1.0 - p[8] * (1.0 - np.sqrt(max(left, 0.0))))
    return p[0] * w - p[0] / p[1] * pressure - flow - p[3] * pressure


@numba.njit
def _rigid(spool: float, flow: float, p: Any) -> float:
    """P12 at which the edges give what the jack takes."""
    low, high = -p[4], p[4]
    if _excess(low, spool, flow, p) <= 0.0:
        return low
    if _excess(high, spool, flow, p) >= 0.0:
        return high
    for _ in range(60):
        middle = 0.5 * (low + high)
        if _excess(middle, spool, flow, p) > 0.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@numba.njit
def _run(p: Any, spool: Any, load: Any, h: float, out: Any) -> None:
    # p: GQ, GP, AJ, CLK, PSR, MJ, CJ, V/4B, share of the root, FDJ, s0, s1, FSJ - FDJ, speed of the bristles
    x = v = z = pressure = 0.0
    for i in range(len(spool)):
        if p[7] > 0.0:
            pressure += h / p[7] * _excess(pressure, spool[i], p[2] * v, p)
            pressure = min(max(pressure, -p[4]), p[4])
        else:
            pressure = _rigid(spool[i], p[2] * v, p)
        level = p[9] + (p[12] * np.exp(-(v / p[13])**2) if p[13] > 0.0 else 0.0)
        bristle = v - p[10] * abs(v) * z / level if level > 0.0 else 0.0
        v += h / p[5] * (p[2] * pressure - p[6] * v - load[i] - p[10] * z - p[11] * bristle)
        z += h * bristle
        x += h * v
        out[0, i], out[1, i] = x, pressure


def simulate_jack(values: Mapping[str, float], spool: Any, load: Any, h: float) -> Any:
    """Rows XJ, P12 after each step of `h` s under the path `spool` (n,) m and `load` (n,) N; no stick-slip."""
    v = values
    stored = 0.25 * v["compressibility.volume"] * v["compressibility.coefficient"]
    z = v["presliding.deflection"]
    s0 = v["jack.static_friction"] / z if z > 0.0 else 0.0
    p = np.array([v["valve.flow_gain"], v["valve.pressure_gain"], v["jack.area"], v["jack.leakage"],
                  v["supply.pressure"], v["jack.mass"], v["jack.damping"], stored, v["orifice_root.share"],
                  v["jack.dynamic_friction"] if z > 0.0 else 0.0, s0, 0.02 * np.sqrt(s0 * v["jack.mass"]),
                  v["jack.static_friction"] - v["jack.dynamic_friction"], v["presliding.speed"] if z > 0.0 else 0.0])
    out = np.empty((2, len(spool)))
    _run(p, spool, load, h, out)
    return out

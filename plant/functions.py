"""Elementary functions without branches or calls, so that the compiler can turn laws that use them into vector code.

They replace those of `math` and `numpy` in all linked code (`plant.compile`), compiled or interpreted, for one run or
many: a law gives the same bits everywhere. Mathematical libraries do not promise that. The C library and NumPy have
several versions of exp, sin, log and pow, choose by the CPU, and the last bits differ. Methods and coefficients
are those of fdlibm (sin, cos, log) and Cephes (tanh, atan). Errors against libm, in units of the last place (tests hold
them): exp, log, atan 1, sin, cos, tanh 2, tan 3; angles up to 1e6 rad, beyond that a digit is lost a decade. What has
no value is NaN or infinite instead of an exception.
"""

import math
from math import inf, nan, sqrt
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", float, NDArray[np.float64])
ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to a whole number, found in the low bits of the sum


def _bits(x: float) -> Any:
    return np.float64(x).view(np.int64)


def _number(bits: Any) -> float:
    return float(np.int64(bits).view(np.float64))


def _two_to(n: float) -> float:
    """2^n for a whole number between -1022 and 1023."""
    return _number(_bits(n + (ROUND + 1023.0)) << 52)


def exp(x: float) -> float:
    """e^x: the whole powers of two out, Taylor's series for the rest."""
    exponent = x if x > -746.0 else -746.0
    exponent = exponent if exponent < 710.0 else 710.0
    n = (exponent * 1.4426950408889634 + ROUND) - ROUND
    r = (exponent - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10  # ln 2 in two parts
    y = _exp_series(r)
    half = (0.5 * n + ROUND) - ROUND  # in two factors: 2^n alone leaves the range before e^x does
    y = y * _two_to(half) * _two_to(n - half)
    return y if x == x else x


def _exp_series(r: Number) -> Number:
    """e^r for |r| <= ln(2)/2, by Taylor's series."""
    y = 1.6059043836821613e-10 * r + 2.08767569878681e-09
    y = y * r + 2.505210838544172e-08
    y = y * r + 2.755731922398589e-07
    y = y * r + 2.7557319223985893e-06
    y = y * r + 2.48015873015873e-05
    y = y * r + 0.0001984126984126984
    y = y * r + 0.001388888888888889
    y = y * r + 0.008333333333333333
    y = y * r + 0.041666666666666664
    y = y * r + 0.16666666666666666
    y = y * r + 0.5
    return 1.0 + (r + r * r * y)


def log(x: float) -> float:
    """The natural logarithm."""
    positive_x = x if x > 0.0 else 1.0
    tiny = positive_x < 2.2250738585072014e-308
    bits = _bits(positive_x * 18014398509481984.0 if tiny else positive_x)
    high = (bits - 0x3FE6A09E667F3BCD) >> 52  # so that the rest is between sqrt(1/2) and sqrt(2)
    k = _number(high + 0x4338000000000000) - ROUND - (54.0 if tiny else 0.0)
    f = _number(bits - (high << 52)) - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    r = z * (6.666666666666735130e-01 + w * (2.857142874366239149e-01 + w * (
        1.818357216161805012e-01 + w * 1.479819860511658591e-01)))
    r = r + w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01))
    half = 0.5 * f * f
    y = k * 6.93147180369123816490e-01 - ((half - (s * (half + r) + k * 1.90821492927058770002e-10)) - f)
    y = y if x > 0.0 else -inf
    y = y if x >= 0.0 else nan
    return y if x < inf else x


def _quarters(x: float) -> tuple[float, float]:
    """`x` as a whole number of quarter turns and the rest; pi/2 in three parts of 33 bits."""
    x = x if abs(x) < 1e15 else nan
    n = (x * 0.6366197723675814 + ROUND) - ROUND
    r = (x - n * 1.57079632673412561417e+00) - n * 6.07710050630396597660e-11
    return n, r - n * 2.02226624879595063154e-21


def _sine(r: Number) -> Number:
    z = r * r
    y = z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))
    y = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + y))
    return r + r * z * y


def _cosine(r: Number) -> Number:
    z = r * r
    y = z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11))
    y = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + y))
    half = 0.5 * z
    w = 1.0 - half
    return w + (((1.0 - w) - half) + z * z * y)


def _sine_ahead(x: float, turned: float) -> float:
    """The sine of an angle that is `turned` quarters further than `x`."""
    n, r = _quarters(x)
    quarter = _bits(n + (ROUND + turned))
    y = _sine(r) if quarter & 1 == 0 else _cosine(r)
    return y if quarter & 2 == 0 else -y


def sin(x: float) -> float:
    """The sine of an angle in radian."""
    return _sine_ahead(x, 0.0)


def cos(x: float) -> float:
    """The cosine of an angle in radian."""
    return _sine_ahead(x, 1.0)


def tan(x: float) -> float:
    """The tangent of an angle in radian."""
    n, r = _quarters(x)
    s, c = _sine(r), _cosine(r)
    even = _bits(n + ROUND) & 1 == 0
    return (s if even else -c) / (c if even else s)


def tanh(x: float) -> float:
    """The hyperbolic tangent: a rational function near zero, by e^x elsewhere."""
    z = x * x
    p = z * ((-9.64399179425052238628e-1 * z - 9.92877231001918586564e1) * z - 1.61468768441708447952e3)
    q = ((z + 1.12811678491632931402e2) * z + 2.23548839060100448583e3) * z + 4.84406305325125486048e3
    size = abs(x)
    far = 1.0 - 2.0 / (exp(2.0 * size) + 1.0)
    return x + x * (p / q) if size < 0.625 else far if x > 0.0 else -far


def atan(x: float) -> float:
    """The angle in radian whose tangent is `x`."""
    size = abs(x)
    steep, middle = size > 2.414213562373095, size > 0.66
    r = (-1.0 if steep else size - 1.0 if middle else size) / (size if steep else size + 1.0 if middle else 1.0)
    z = r * r
    p = -7.500855792314704667340e1 + z * (-1.615753718733365076637e1 + z * -8.750608600031904122785e-1)
    p = z * (-6.485021904942025371773e1 + z * (-1.228866684490136173410e2 + z * p))
    q = 4.328810604912902668951e2 + z * (1.650270098316988542046e2 + z * (2.485846490142306297962e1 + z))
    q = 1.945506571482613964425e2 + z * (4.853903996359136964868e2 + z * q)
    rest = 6.123233995736765886130e-17 if steep else 3.061616997868382943065e-17 if middle else 0.0
    turned = 1.5707963267948966 if steep else 0.7853981633974483 if middle else 0.0
    y = turned + ((r * (p / q) + rest) + r)
    return y if x >= 0.0 else -y


def hypot(x: float, y: float) -> float:
    """The length of (x, y), for numbers whose squares exist."""
    return sqrt(x * x + y * y)


def sin_of_turns(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """sin(2 pi `turns`) of an array of any shape, in whole turns; exactly zero after every half turn."""
    part = np.mod(turns, 1.0)
    quarter = np.rint(4.0 * part)
    r = (part - 0.25 * quarter) * (2.0 * np.pi)  # the difference is exact
    y = np.where(quarter % 2.0 == 0.0, _sine(r), _cosine(r))
    return np.where((quarter == 2.0) | (quarter == 3.0), -y, y)


def exp_of(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """e^x of an array of any shape, the bits of `exp`."""
    exponents = np.clip(x, -746.0, 710.0)
    n = np.rint(exponents * 1.4426950408889634)
    r = (exponents - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10
    half = np.rint(0.5 * n)
    return np.asarray(np.ldexp(np.ldexp(_exp_series(r), half.astype(int)), (n - half).astype(int)))


IN_PLACE_OF: dict[Any, Any] = {
    math.exp: exp, np.exp: exp, math.log: log, np.log: log, math.sin: sin, np.sin: sin, math.cos: cos, np.cos: cos,
    math.tan: tan, np.tan: tan, math.tanh: tanh, np.tanh: tanh, math.atan: atan, np.arctan: atan,
    math.hypot: hypot, np.hypot: hypot,
}
"""Functions that laws name, and what they get."""

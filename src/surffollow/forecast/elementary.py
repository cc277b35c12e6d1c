"""Elementary functions of the kernels, from the four operations, roots and bits alone.

IEEE 754 defines those to the last bit. The functions of a mathematical library differ in that bit between
libraries and processors, and a recording would not replay on another machine. Loops over models vectorise
with these ones. Errors are below 2e-15 of the result, of sines and cosines below 1e-15.
"""

import math

import numpy as np

from surffollow.shm.jit import jit_inlined

# adding and subtracting it rounds to an integer, which is in the lowest bits of the sum
_ROUND = 1.5 * 2.0**52
_BIAS = 2.0**52 + 1023.0  # added to an integer n: the bits of 2^n, but for their place
_MANTISSA, _ONE, _TWO_52 = 2**52 - 1, 0x3FF << 52, 0x433 << 52
# constants in parts: multiples of the first ones are exact
_LN2 = (0.693145751953125, 1.428606820309417232e-6)
_RIGHT_ANGLE = (13176794.0 / 2.0**23, math.pi / 2.0 - 13176794.0 / 2.0**23, 6.123233995736766e-17)


@jit_inlined
def exp(x):
    """The exponential of x; 0 below −700, that of 700 above.

    With n = x / ln 2, rounded, and the rest r it is 2^n e^r; of e^r the Padé approximant of order 5.
    """
    limited = min(max(x, -700.0), 700.0)
    n = (limited * 1.4426950408889634 + _ROUND) - _ROUND
    r = (limited - n * _LN2[0]) - n * _LN2[1]
    s = r * r
    even, odd = 30240.0 + s * (3360.0 + s * 30.0), r * (15120.0 + s * (420.0 + s))
    power = np.int64(np.float64(n + _BIAS).view(np.int64) << 52)
    return 0.0 if x < -700.0 else (even + odd) / (even - odd) * power.view(np.float64)


@jit_inlined
def log(x):
    """The natural logarithm of x, a normal number; NaN where it is not finite or not positive.

    With x = 2^n m, √½ < m ≤ √2, it is n ln 2 + 2 artanh((m − 1)/(m + 1)); of that ten terms of its series.
    """
    bits = np.float64(x).view(np.int64)
    n = np.int64(bits >> 52 | _TWO_52).view(np.float64) - _BIAS
    m = np.int64(bits & _MANTISSA | _ONE).view(np.float64)
    halved = m > math.sqrt(2.0)
    m, n = (0.5 * m if halved else m), (n + 1.0 if halved else n)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 1.0 / 11.0 + z * (1.0 / 13.0 + z * (1.0 / 15.0 + z * (1.0 / 17.0 + z / 19.0)))
    p = 1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0 + z * p)))
    ln = n * _LN2[0] + (2.0 * (s + s * z * p) + n * _LN2[1])
    return ln if 0.0 < x < math.inf else math.nan


@jit_inlined
def sin_cos(x):
    """Sine and cosine of x [rad], up to 10⁶; of their series the terms to x¹⁵ and x¹⁶."""
    t = x * (2.0 / math.pi) + _ROUND
    n, quadrant = t - _ROUND, np.float64(t).view(np.int64)
    r = ((x - n * _RIGHT_ANGLE[0]) - n * _RIGHT_ANGLE[1]) - n * _RIGHT_ANGLE[2]
    z = r * r
    p = -1.0 / 39916800.0 + z * (1.0 / 6227020800.0 - z / 1307674368000.0)
    p = -1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362880.0 + z * p)))
    q = -1.0 / 3628800.0 + z * (1.0 / 479001600.0 + z * (-1.0 / 87178291200.0 + z / 20922789888000.0))
    q = 1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40320.0 + z * q))
    s, c = r + r * z * p, 1.0 - 0.5 * z + z * z * q
    swapped = quadrant & 1 != 0
    sine, cosine = (c if swapped else s), (s if swapped else c)
    return (-sine if quadrant & 2 != 0 else sine), (-cosine if (quadrant + 1) & 2 != 0 else cosine)


@jit_inlined
def hypot(x, y):
    """Length of a vector, √(x² + y²)."""
    return math.sqrt(x * x + y * y)


@jit_inlined
def angle(sine, cosine):
    """Angle from 0 to π with this sine ≥ 0 and cosine, times any factor, not both 0 [rad].

    Its tangent is halved three times; of the arc tangent the terms to x²¹ of its series.
    """
    t = sine / (hypot(sine, cosine) + abs(cosine))
    t /= 1.0 + math.sqrt(1.0 + t * t)
    t /= 1.0 + math.sqrt(1.0 + t * t)
    z, p = t * t, 0.0
    for k in range(21, 1, -2):
        p = z * (1.0 / k - p)
    acute = 8.0 * t * (1.0 - p)
    return math.pi - acute if cosine < 0.0 else acute

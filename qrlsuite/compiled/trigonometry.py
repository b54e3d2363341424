"""Sine and cosine of a vector, by polynomials: scalar library calls would cost more than the gates.

x is reduced by the nearest multiple k of pi to r in [-pi/2, pi/2]. Where the processor fuses multiplication and
addition, pi is written in two parts. Elsewhere it is written in three, of which the first two have so few bits that
their products with k are exact (Cody & Waite 1980, "Software Manual for the Elementary Functions"). Then, with
z = r^2, sin r = r + r z S(z), cos r = 1 + z C(z), and both change sign with odd k. S and C interpolate at Chebyshev
nodes; their largest errors are 2e-8 and 1e-9 (float32), 2e-17 and 9e-18 (float64).
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import overload

from qrlsuite.compiled.cache import inlined
from qrlsuite.compiled.vectors import FUSED, Vector, constant, floor, fma, nearest

INVERSE_PI = 0.3183098861837907
PI32 = (3.1415927410125732, -8.742277657347586e-08, 0.0)
PI64 = (3.141592653589793, 1.2246467991473532e-16, 0.0)
if not FUSED:
    PI32 = (3.140625, 0.0009675025939941406, 1.5099580252808664e-07)
    PI64 = (3.1415926534682512, 1.2154201013012384e-10, 0.0)

S32 = (-0.16666665958226323, 0.008333241592520583, -0.00019822666349960692, 2.6345196812009277e-06)
C32 = (
    -0.4999999996359358,
    0.04166665930189162,
    -0.0013888650236327064,
    2.4774473179513106e-05,
    -2.62950531147193e-07,
)
S64 = (
    -0.16666666666666666, 0.008333333333333316, -0.00019841269841254795, 2.7557319219115034e-06,
    -2.5052107610864233e-08, 1.6058976915293983e-10, -7.64395762890072e-13, 2.7312869702054162e-15,
)  # fmt: skip
C64 = (
    -0.5, 0.041666666666666664, -0.0013888888888888814, 2.480158730155628e-05, -2.7557319217529157e-07,
    2.087675623279294e-09, -1.1470693702901042e-11, 4.777396669057386e-14, -1.5168279480992167e-16,
)  # fmt: skip


@inlined
def _reduced(x: Any, pi: float, middle: float, rest: float) -> Any:
    """Return r in [-pi/2, pi/2] with x = k pi + r, and (-1)^k."""
    k = nearest(x * constant(x, INVERSE_PI))
    r = fma(k, constant(x, -pi), x)
    r = fma(k, constant(x, -middle), r)
    r = fma(k, constant(x, -rest), r)
    half = floor(k * constant(x, 0.5))
    return r, constant(x, 1.0) - constant(x, 2.0) * (k - half - half)


@inlined
def _combined(r: Any, sign: Any, s: Any, c: Any) -> Any:
    z = r * r
    return sign * fma(r * z, s, r), sign * fma(z, c, constant(r, 1.0))


@inlined
def _sine_cosine32(x: Any) -> Any:
    r, sign = _reduced(x, PI32[0], PI32[1], PI32[2])
    z = r * r
    s = constant(x, S32[3])
    s = fma(s, z, constant(x, S32[2]))
    s = fma(s, z, constant(x, S32[1]))
    s = fma(s, z, constant(x, S32[0]))
    c = constant(x, C32[4])
    c = fma(c, z, constant(x, C32[3]))
    c = fma(c, z, constant(x, C32[2]))
    c = fma(c, z, constant(x, C32[1]))
    c = fma(c, z, constant(x, C32[0]))
    return _combined(r, sign, s, c)


@inlined
def _sine_cosine64(x: Any) -> Any:
    r, sign = _reduced(x, PI64[0], PI64[1], PI64[2])
    z = r * r
    s = constant(x, S64[7])
    for coefficient in (S64[6], S64[5], S64[4], S64[3], S64[2], S64[1], S64[0]):
        s = fma(s, z, constant(x, coefficient))
    c = constant(x, C64[8])
    for coefficient in (C64[7], C64[6], C64[5], C64[4], C64[3], C64[2], C64[1], C64[0]):
        c = fma(c, z, constant(x, coefficient))
    return _combined(r, sign, s, c)


def sine_cosine(x: Any) -> Any:
    """Return (sin x, cos x) of a vector; only inside kernels."""
    raise NotImplementedError


@overload(sine_cosine, jit_options={"forceinline": True})
def _choose(x: Any) -> Any:
    if not isinstance(x, Vector):
        return None

    def single(x: Any) -> Any:
        return _sine_cosine32(x)

    def double(x: Any) -> Any:
        return _sine_cosine64(x)

    return single if x.element == types.float32 else double

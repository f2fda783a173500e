"""Classic minimax problems with published optima; every function takes complex numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import Bounds, LinearConstraint

Array = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class Classic:
    fun: Callable[[Array], Any]
    start: tuple[float, ...]
    best: float
    bounds: Bounds | None = None
    constraints: tuple[LinearConstraint, ...] = ()


def both(f: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """max |f_i| as the max of f_i and -f_i."""
    return lambda x: np.concatenate([f(x), -f(x)])


def penalised(f: Any, constraints: list[Any], price: float = 10.0) -> Array:
    return np.array([f, *(f + price * c for c in constraints)])


def cb2(x: Array) -> Array:
    a, b = x
    return np.array([a**2 + b**4, (2 - a) ** 2 + (2 - b) ** 2, 2 * np.exp(b - a)])


def cb3(x: Array) -> Array:
    a, b = x
    return np.array([a**4 + b**2, (2 - a) ** 2 + (2 - b) ** 2, 2 * np.exp(b - a)])


def dem(x: Array) -> Array:
    a, b = x
    return np.array([5 * a + b, -5 * a + b, a**2 + b**2 + 4 * b])


def ql(x: Array) -> Array:
    a, b = x
    return penalised(a**2 + b**2, [-4 * a - b + 4, -a - 2 * b + 6])


def lq(x: Array) -> Array:
    a, b = x
    return np.array([-a - b, -a - b + a**2 + b**2 - 1])


def mifflin1(x: Array) -> Array:
    a, b = x
    return penalised(-a, [a**2 + b**2 - 1], 20)


def mifflin2(x: Array) -> Array:
    a, b = x
    s = a**2 + b**2 - 1
    return np.array([-a + 3.75 * s, -a + 0.25 * s])


def rosen_suzuki(x: Array) -> Array:
    a, b, c, d = x
    f = a**2 + b**2 + 2 * c**2 + d**2 - 5 * a - 5 * b - 21 * c + 7 * d
    return penalised(
        f,
        [
            a**2 + b**2 + c**2 + d**2 + a - b + c - d - 8,
            a**2 + 2 * b**2 + c**2 + 2 * d**2 - a - d - 10,
            2 * a**2 + b**2 + c**2 + 2 * a - b - d - 5,
        ],
    )


def polak6(x: Array) -> Array:
    first = x[0] - (x[3] + 1) ** 4
    return rosen_suzuki(np.array([first, x[1] - first**4, x[2], x[3]]))


SHOR_B = np.array([1, 5, 10, 2, 4, 3, 1.7, 2.5, 6, 3.5])
SHOR_A = np.array(
    [
        [0, 0, 0, 0, 0], [2, 1, 1, 1, 3], [1, 2, 1, 1, 2], [1, 4, 1, 2, 2], [3, 2, 1, 0, 1],
        [0, 2, 1, 0, 1], [1, 1, 1, 1, 1], [1, 0, 1, 2, 1], [0, 0, 2, 1, 0], [1, 1, 2, 0, 0],
    ]
)  # fmt: skip


def shor(x: Array) -> Array:
    return np.asarray(SHOR_B * ((x - SHOR_A) ** 2).sum(axis=1))


def maxquad(x: Array) -> Array:
    values = []
    i = np.arange(1, 11)
    for k in range(1, 6):
        upper = np.triu(np.exp(i[:, None] / i) * np.cos(i[:, None] * i) * np.sin(k), 1)
        matrix = upper + upper.T
        matrix += np.diag(i / 10 * abs(np.sin(k)) + np.abs(matrix).sum(axis=1))
        values.append(x @ matrix @ x - np.exp(i / k) * np.sin(i * k) @ x)
    return np.array(values)


def wong1(x: Array) -> Array:
    a, b, c, d, e, f, g = x
    value = (a - 10) ** 2 + 5 * (b - 12) ** 2 + c**4 + 3 * (d - 11) ** 2 + 10 * e**6
    value = value + 7 * f**2 + g**4 - 4 * f * g - 10 * f - 8 * g
    return penalised(
        value,
        [
            2 * a**2 + 3 * b**4 + c + 4 * d**2 + 5 * e - 127,
            7 * a + 3 * b + 10 * c**2 + d - e - 282,
            23 * a + b**2 + 6 * f**2 - 8 * g - 196,
            4 * a**2 + b**2 - 3 * a * b + 2 * c**2 + 5 * f - 11 * g,
        ],
    )


def wong_rows(x: Array) -> list[Any]:
    a, b, c, d, e, f, g, h, i, j = x[:10]
    return [
        3 * (a - 2) ** 2 + 4 * (b - 3) ** 2 + 2 * c**2 - 7 * d - 120,
        5 * a**2 + 8 * b + (c - 6) ** 2 - 2 * d - 40,
        0.5 * (a - 8) ** 2 + 2 * (b - 4) ** 2 + 3 * e**2 - f - 30,
        a**2 + 2 * (b - 2) ** 2 - 2 * a * b + 14 * e - 6 * f,
        4 * a + 5 * b - 3 * g + 9 * h - 105,
        10 * a - 8 * b - 17 * g + 2 * h,
        -3 * a + 6 * b + 12 * (i - 8) ** 2 - 7 * j,
        -8 * a + 2 * b + 5 * i - 2 * j - 12,
    ]


def wong_value(x: Array) -> Any:
    a, b, c, d, e, f, g, h, i, j = x[:10]
    value = a**2 + b**2 + a * b - 14 * a - 16 * b + (c - 10) ** 2 + 4 * (d - 5) ** 2
    value = value + (e - 3) ** 2 + 2 * (f - 1) ** 2 + 5 * g**2 + 7 * (h - 11) ** 2
    return value + 2 * (i - 10) ** 2 + (j - 7) ** 2


def wong2(x: Array) -> Array:
    return penalised(wong_value(x) + 45, wong_rows(x))


def wong3(x: Array) -> Array:
    a, b = x[:2]
    k, l, m, n, o, p, q, r, s, t = x[10:]  # noqa: E741
    value = wong_value(x) + (k - 9) ** 2 + 10 * (l - 1) ** 2 + 5 * (m - 7) ** 2
    value = value + 4 * (n - 14) ** 2 + 27 * (o - 1) ** 2 + p**4 + (q - 2) ** 2
    value = value + 13 * (r - 2) ** 2 + (s - 3) ** 2 + t**2 + 95
    more = [
        a + b + 4 * k - 21 * l,
        a**2 + 15 * k - 8 * l - 28,
        4 * a + 9 * b + 5 * m**2 - 9 * n - 87,
        3 * a + 4 * b + 3 * (m - 6) ** 2 - 14 * n - 10,
        14 * a**2 + 35 * o - 79 * p - 92,
        15 * b**2 + 11 * o - 61 * p - 54,
        5 * a**2 + 2 * b + 9 * q**4 - r - 68,
        a**2 - b + 19 * s - 20 * t + 19,
        7 * a**2 + 5 * b**2 + s**2 - 30 * t,
    ]
    return penalised(value, [*wong_rows(x), *more])


def crescent(x: Array) -> Array:
    a, b = x
    s = a**2 + (b - 1) ** 2
    return np.array([s + b - 1, -s + b + 1])


def davidon2(x: Array) -> Array:
    t = 0.2 * np.arange(1, 21)
    first = x[0] + x[1] * t - np.exp(t)
    return np.asarray(first**2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2)


def oet5(x: Array) -> Array:
    t = 0.25 + 0.75 * np.arange(21) / 20
    return np.asarray(x[3] - (x[0] * t**2 + x[1] * t + x[2]) ** 2 - np.sqrt(t))


def oet6(x: Array) -> Array:
    t = -0.5 + np.arange(21) / 20
    return np.asarray(x[0] * np.exp(x[2] * t) + x[1] * np.exp(x[3] * t) - 1 / (1 + t))


def kowalik_osborne(x: Array) -> Array:
    u = np.array([4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])
    y = np.array(
        [0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246]
    )
    return np.asarray(x[0] * (u**2 + x[1] * u) / (u**2 + x[2] * u + x[3]) - y)


def exp_fit(x: Array) -> Array:
    t = -1 + np.arange(21) / 10
    return np.asarray((x[0] + x[1] * t) / (1 + x[2] * t + x[3] * t**2 + x[4] * t**3) - np.exp(t))


def bard(x: Array) -> Array:
    y = np.array(
        [0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39]
    )
    u = np.arange(1, 16)
    v = 16 - u
    return np.asarray(x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]) - y)


def mad1(x: Array) -> Array:
    a, b = x
    return np.array([a**2 + b**2 + a * b - 1, np.sin(a), -np.cos(b)])


def mad4(x: Array) -> Array:
    a, b = x
    return np.array([-np.exp(a - b), np.sinh(a - 1) - 1, -np.log(b) - 1])


def spiral(x: Array) -> Array:
    a, b = x
    s = np.sqrt(a**2 + b**2)
    return np.array(
        [(a - s * np.cos(s)) ** 2 + 0.005 * s**2, (b - s * np.sin(s)) ** 2 + 0.005 * s**2]
    )


def goffin(x: Array) -> Array:
    return 50 * x - x.sum()


def colville1(x: Array) -> Array:
    e = np.array([-15, -27, -36, -18, -12])
    d = np.array([4, 8, 10, 6, 2])
    c = np.array(
        [
            [30, -20, -10, 32, -10],
            [-20, 39, -6, -31, 32],
            [-10, -6, 10, -6, -10],
            [32, -31, -6, 39, -20],
            [-10, 32, -10, -20, 30],
        ]
    )
    return np.array([e @ x + x @ c @ x + d @ x**3])


COLVILLE_ROWS = np.array(
    [
        [-16, 2, 0, 1, 0], [0, -2, 0, 4, 2], [-3.5, 0, 2, 0, 0], [0, -2, 0, -4, -1],
        [0, -9, -2, 1, -2.8], [2, 0, -4, 0, 0], [-1, -1, -1, -1, -1], [-1, -2, -3, -2, -1],
        [1, 2, 3, 4, 5], [1, 1, 1, 1, 1],
    ]
)  # fmt: skip
COLVILLE_LEAST = np.array([-40, -2, -0.25, -4, -4, -1, -40, -60, 5, 1])


def at_least(row: list[float], bound: float) -> tuple[LinearConstraint, ...]:
    return (LinearConstraint(np.array([row]), bound, np.inf),)


W2 = (2, 3, 5, 5, 1, 2, 7, 3, 6, 10)
CLASSICS = {
    "CB2": Classic(cb2, (2, 2), 1.9522245),
    "CB3": Classic(cb3, (2, 2), 2.0),
    "DEM": Classic(dem, (1, 1), -3.0),
    "QL": Classic(ql, (-1, 5), 7.2),
    "LQ": Classic(lq, (-0.5, -0.5), -1.4142136),
    "Mifflin1": Classic(mifflin1, (0.8, 0.6), -1.0),
    "Mifflin2": Classic(mifflin2, (-1, -1), -1.0),
    "Rosen-Suzuki": Classic(rosen_suzuki, (0, 0, 0, 0), -44.0),
    "Shor": Classic(shor, (0, 0, 0, 0, 1), 22.600162),
    "Maxquad": Classic(maxquad, (1,) * 10, -0.8414083),
    "Wong1": Classic(wong1, (1, 2, 0, 4, 0, 1, 1), 680.63006),
    "Wong2": Classic(wong2, W2, 24.306209),
    "Wong3": Classic(wong3, (*W2, 2, 2, 6, 15, 1, 2, 1, 2, 1, 3), 133.72828),
    "Crescent": Classic(crescent, (-1.5, 2), 0.0),
    "Davidon2": Classic(davidon2, (25, 5, -5, -1), 115.70644),
    "OET5": Classic(both(oet5), (1, 1, 1, 1), 0.0026359735),
    "OET6": Classic(both(oet6), (1, 1, -3, -1), 0.0020160753),
    "Polak6": Classic(polak6, (0, 0, 0, 0), -44.0),
    "Kowalik-Osborne": Classic(both(kowalik_osborne), (0.25, 0.39, 0.415, 0.39), 0.0080843684),
    "EXP": Classic(both(exp_fit), (0.5, 0, 0, 0, 0), 0.00012237125),
    "Bard": Classic(both(bard), (1, 1, 1), 0.050816327),
    "MAD1": Classic(mad1, (1, 2), -0.38965952, constraints=at_least([1, 1], 0.5)),
    "MAD2": Classic(mad1, (-2, -1), -0.33035714, constraints=at_least([-3, -1], 2.5)),
    "MAD4": Classic(mad4, (-1, 0.01), -0.44891079, constraints=at_least([0.05, -1], -0.5)),
    "MAD5": Classic(mad4, (-1, 3), -0.42928061, constraints=at_least([-0.9, 1], 1.0)),
    "Spiral": Classic(spiral, (1.411831, -4.79462), 0.0),
    "Goffin": Classic(goffin, tuple(np.arange(1, 51) - 25.5), 0.0),
    "Colville1": Classic(
        colville1,
        (0, 0, 0, 0, 1),
        -32.348679,
        Bounds(np.zeros(5), np.full(5, np.inf)),
        (LinearConstraint(COLVILLE_ROWS, COLVILLE_LEAST, np.full(10, np.inf)),),
    ),
}

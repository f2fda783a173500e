"""Derivatives of functions given by values, and the scale of each variable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError

Function = Callable[[Array], Array]
DERIVATIVE_SCHEMES = ("cs", "3-point", "2-point")
COMPLEX_STEP = 1e-30
EPS = float(np.finfo(float).eps)

RELATIVE_PROBE_STEP = 1e-4  # step of a probe, relative to the length of the variable
MIN_RELATIVE_PROBE_STEP = 1e-12  # relative to the variable: less is its rounding
MAX_PROBES_PER_LENGTH = 40  # of one length
MAX_LENGTH_RATIO = 1e4  # by which one probe may lengthen a variable's length
GRADIENT_CHECK_DIRECTIONS = 3  # in which a given gradient is compared with differences
GRADIENT_CHECK_DISTANCE = (
    1e-3  # distance of the second place of that check, relative to the lengths
)
MAX_RELATIVE_GRADIENT_ERROR = (
    1e-2  # relative to the steepest slope; above it, the gradient is wrong
)


class CountedFunction:
    """A function that counts its calls and returns a copy, since callers may reuse a buffer."""

    def __init__(self, function: Callable[[Array], Any]) -> None:
        """function: (n,) -> numbers, real or complex."""
        self.function = function
        self.count = 0

    def __call__(self, x: Array) -> Array:
        """(m,) values at x (n,)."""
        self.count += 1
        with np.errstate(all="ignore"):
            return np.atleast_1d(np.array(self.function(x.copy())))


class CountedJacobian:
    """The Jacobian of a function as a function of x alone: given, or by differences.

    scheme: a function (n,) -> (m, n), or "cs", "3-point", "2-point".
    lengths: (n,) over which the variables matter; differences take steps in shares of them, or of
    |x| where it is larger.
    """

    def __init__(
        self, function: Function, scheme: Callable[[Array], Any] | str, lengths: Array
    ) -> None:
        """Raises OptionError for an unknown scheme."""
        if not callable(scheme) and scheme not in DERIVATIVE_SCHEMES:
            raise OptionError(
                f"minimize_max: jac {scheme!r}: give a function, True, 'cs', '3-point' or '2-point'"
            )
        self.function, self.scheme, self.lengths = function, scheme, lengths
        self.count = 0

    def __call__(self, x: Array) -> Array:
        """(m, n) at x (n,)."""
        self.count += 1
        if callable(self.scheme):
            return to_dense_matrix(self.scheme(x.copy()))
        if self.scheme == "cs":
            return complex_step_jacobian(self.function, x, self.lengths)
        return self.difference_jacobian_at(x, self.scheme == "3-point")

    def central_difference_jacobian(self, x: Array) -> Array:
        """(m, n) at x, by central differences in place of forward ones."""
        return self.difference_jacobian_at(x, True) if self.scheme == "2-point" else self(x)

    def difference_jacobian_at(self, x: Array, is_central: bool) -> Array:
        """(m, n) at x by central or forward differences."""
        steps = np.maximum(np.abs(x), self.lengths)
        return difference_jacobian(self.function, x, steps, is_central)

    @property
    def relative_rounding(self) -> float:
        """Relative error of slopes: that of numbers, or that of central differences."""
        return EPS ** (2.0 / 3.0) if self.scheme in ("2-point", "3-point") else EPS


def to_dense_matrix(matrix: Any) -> Array:
    """A matrix, sparse or not, as a new two-dimensional array of floats."""
    whole: Any = matrix.toarray() if hasattr(matrix, "toarray") else matrix
    return np.atleast_2d(np.array(whole, dtype=float))


def difference_jacobian(function: Function, x: Array, lengths: Array, is_central: bool) -> Array:
    """(m, n) by central or forward differences, with steps in shares of lengths (n,).

    One-sided where the functions have no finite value on the other side of x.
    """
    steps = np.diag(EPS ** (1.0 / 3.0 if is_central else 0.5) * lengths)
    here = function(x)
    columns = []
    for step in steps:
        ahead = function(x + step)
        behind = function(x - step) if is_central or not np.all(np.isfinite(ahead)) else here
        size = step.sum()
        with np.errstate(all="ignore"):
            forward, backward = (ahead - here) / size, (here - behind) / size
            middle = (ahead - behind) / (2.0 * size) if is_central else forward
        column = np.where(np.isfinite(middle), middle, forward)
        columns.append(np.where(np.isfinite(column), column, backward))
    return np.stack(columns, axis=-1)


def complex_step_jacobian(function: Function, x: Array, lengths: Array) -> Array:
    """(m, n), exact for functions that take complex numbers [Squire and Trapp 1998].

    lengths: (n,) of the variables; the steps are far below them, yet large enough that the
    imaginary parts of small values do not underflow.
    """
    level = float(np.abs(function(x)).max(initial=0.0))
    smallest = float(np.finfo(float).tiny)
    sizes = max(COMPLEX_STEP, 1e2 * smallest / max(level, smallest)) * lengths
    places = x + 1j * np.diag(sizes)
    return np.stack(
        [function(z).imag / size for z, size in zip(places, sizes, strict=True)], axis=-1
    )


def measure_variable_lengths(
    function: Function, x: Array, lower: Any, upper: Any, level: float, initial_lengths: Array
) -> Array:
    """(n,) over which a variable alone takes some function above the largest by `level`.

    By slopes and curvatures, since either may vanish at x; at most the width of its bounds.
    initial_lengths: (n,) a guess; it, or |x|, is kept where no function depends on the variable.
    """
    f = function(x)
    room = level + (f.max(initial=0.0) - f if len(f) else f)
    width = np.where(upper > lower, np.subtract(upper, lower), np.inf)
    initial_lengths = lengths = np.minimum(initial_lengths, width)
    with np.errstate(all="ignore"):  # a value beside x may be infinite
        for _ in range(MAX_PROBES_PER_LENGTH):
            steps = np.maximum(RELATIVE_PROBE_STEP * lengths, MIN_RELATIVE_PROBE_STEP * np.abs(x))
            no_room_above, no_room_below = x + steps > upper, x - steps < lower
            ahead_steps = np.diag(np.where(no_room_above, 0.0, steps))
            back_steps = np.diag(np.where(no_room_below, 0.0, steps))
            ahead = np.array([function(x + step) - f for step in ahead_steps]) / room
            back = np.array([function(x - step) - f for step in back_steps]) / room
            is_open_above = ~no_room_above[:, None] & np.isfinite(ahead)
            is_open_below = ~no_room_below[:, None] & np.isfinite(back)
            ahead, back = (
                np.where(is_open_above, ahead, -back),
                np.where(is_open_below, back, -ahead),
            )
            change = np.maximum(np.abs(ahead - back) / 2.0, np.sqrt(np.abs(ahead + back)))
            seen = change.max(axis=1, initial=0.0)
            seen = np.where(np.isfinite(seen), seen, 1.0)
            found = np.minimum(
                steps / np.maximum(seen, RELATIVE_PROBE_STEP / MAX_LENGTH_RATIO), width
            )
            if np.all((found >= 0.1 * lengths) & (found <= 10.0 * lengths)):
                break
            lengths = np.where(found < lengths, found, np.sqrt(found * lengths))
    return np.where(seen > 0.0, found, np.minimum(np.maximum(initial_lengths, np.abs(x)), width))


def find_function_with_wrong_gradient(
    function: Function, jacobian: Function, x: Array, lower: Any, upper: Any, lengths: Array
) -> int | None:
    """Index of a function whose gradient differs from its differences; None if there is none.

    Along a few directions between the bounds, at x and, against a kink just there, beside it.
    """
    rng = np.random.default_rng(0)
    reach = np.maximum(np.abs(x), lengths)
    found: list[set[int]] = []
    beside = x + GRADIENT_CHECK_DISTANCE * reach * rng.uniform(-1.0, 1.0, size=len(x))
    for place in (x, np.clip(beside, lower, upper)):
        slopes, values = jacobian(place), function(place)
        if not (np.all(np.isfinite(slopes)) and np.all(np.isfinite(values))):
            return None
        wrong = np.zeros(len(values), dtype=bool)
        for _ in range(GRADIENT_CHECK_DIRECTIONS):
            way = EPS ** (1.0 / 3.0) * reach * rng.normal(size=len(x))
            ends = np.clip(place + way, lower, upper), np.clip(place - way, lower, upper)
            with np.errstate(all="ignore"):
                ahead, back = (function(end) for end in ends)
                seen, said = ahead - back, slopes @ (ends[0] - ends[1])
                rounding = 1e3 * EPS * (np.abs(ahead) + np.abs(back))
                bent = 2.0 * np.abs(ahead + back - 2.0 * values)  # more than differences miss
                steep = np.linalg.norm(slopes * way, axis=1) + np.abs(seen)
                error = np.abs(seen - said)
                wrong |= np.isfinite(error) & (
                    error > MAX_RELATIVE_GRADIENT_ERROR * steep + rounding + bent
                )
        found.append(set(np.flatnonzero(wrong).tolist()))
    return min(found[0] & found[1], default=None)

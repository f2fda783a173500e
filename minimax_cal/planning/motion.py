"""Excitations: finite Fourier series of the joints that begin and end at rest, within limits.

A joint follows q(t) = c + sum over k of a_k cos(k w t) + b_k sin(k w t), w = 2 pi / T [Swevers et
al. 1997], with sum k b_k = 0 and sum k^2 a_k = 0: no speed and no acceleration at either end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.dynamics.regressor import Motion
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.planning.visibility import ARM, Room, Sight, View
from minimax_cal.robots.kinematics import chain

CHECKED_HZ = 25.0  # rows at which joints, speeds and accelerations are looked at
POINTS_HZ, SURE_HZ = 10.0, 50.0  # and the arm's points: in the search, and once it has ended
MARGIN = 0.98  # of limits that a series reaches: between those rows it goes a little farther
SHRINKS = 0.7  # factor by which a motion about a pose is made smaller until it is free
LEAST_SHARE = 0.1  # of its largest size, below which another pose is tried
POSES, IN_VAIN = 1000, 60  # poses drawn, and motions tried about free ones, before giving up
STILL = 1e-3  # a point that moves by less is none of the arm's moving ones [m]


@dataclass(frozen=True, eq=False)
class Series:
    """centre: (n,).  a, b: (K, n) of cos and sin [rad, m].  period: [s]."""

    centre: Array
    a: Array
    b: Array
    period: float

    def at(self, time: Array) -> Motion:
        """The motion at times (m,) [s]."""
        w = 2.0 * np.pi / self.period * np.arange(1, len(self.a) + 1)
        cos, sin = np.cos(time[:, None] * w), np.sin(time[:, None] * w)
        return Motion(
            self.centre + cos @ self.a + sin @ self.b,
            (cos * w) @ self.b - (sin * w) @ self.a,
            -(cos * w**2) @ self.a - (sin * w**2) @ self.b,
        )

    def grid(self, rate: float) -> Array:
        """Times of a whole period at a rate [Hz]: (m,) [s]."""
        return np.arange(round(self.period * rate) + 1) / rate

    def sized(self, factor: Array | float) -> Series:
        """The same about its centre, each joint's motion by a factor."""
        return replace(self, a=factor * self.a, b=factor * self.b)


@dataclass(frozen=True, eq=False)
class Bounds:
    """What a motion may do.  room: limits of the joints, floor and box.  box: (2, 3), or empty.

    speed, acceleration: (n,) at most [rad/s, rad/s^2; m].
    """

    room: Room
    box: Array
    speed: Array
    acceleration: Array


def at_rest(a: Array, b: Array) -> tuple[Array, Array]:
    """The nearest coefficients (K, n) without speed and acceleration at the ends."""
    k = np.arange(1.0, len(a) + 1.0)[:, None]
    return a - k**2 * (k**2 * a).sum(0) / (k**4).sum(), b - k * (k * b).sum(0) / (k**2).sum()


def as_large(series: Series, bounds: Bounds) -> Series:
    """The series, each joint's motion as large as its limits allow about its centre."""
    moved = series.at(series.grid(CHECKED_HZ))
    off = moved.q - series.centre
    room = bounds.room
    with np.errstate(divide="ignore", invalid="ignore"):  # a joint without a drive stays
        up = (room.upper - series.centre) / np.maximum(off.max(axis=0), 0.0)
        down = (series.centre - room.lower) / np.maximum(-off.min(axis=0), 0.0)
        quick = bounds.speed / np.abs(moved.qd).max(axis=0)
        hard = bounds.acceleration / np.abs(moved.qdd).max(axis=0)
    factor = MARGIN * np.min([up, down, quick, hard], axis=0)
    return series.sized(np.where(np.isfinite(factor), factor, 0.0))


def free(q: Array, bounds: Bounds) -> Array:
    """(m,) True where the arm's points are in the box, above the floor and clear of each other.

    q: (m, n) [rad, m].
    """
    room = bounds.room
    view = View(room, Sight(np.zeros(3), room.robot.up), q)
    out = np.asarray(ARM["floor"](view) & ARM["self-collision"](view))
    return out & inside(room, q, bounds.box) if len(bounds.box) else out


def inside(room: Room, q: Array, box: Array) -> Array:
    """(m,) True where all moving origins of the arm's links are in a box.  box: (2, 3) [m]."""
    robot = room.robot
    points = chain(robot.mdh, np.ascontiguousarray(robot.turned(q)), robot.prismatic).after
    low, high = box[:, None, :, None]
    within = np.all((points >= low) & (points <= high), axis=1)
    return np.asarray(within[moving_links(room)].all(axis=0))


def moving_links(room: Room) -> Array:
    """(n,) True for the links whose origin moves as the joints do."""
    robot = room.robot
    q = np.random.default_rng(0).uniform(room.lower, room.upper, (20, robot.joints))
    points = chain(robot.mdh, robot.turned(q), robot.prismatic).after
    return np.asarray(np.ptp(points, axis=-1).max(axis=-1) > STILL)


def is_free(series: Series, bounds: Bounds, rate: float = POINTS_HZ) -> bool:
    """Whether the arm's points are free all along a motion.  rate: of the rows looked at [Hz]."""
    return bool(free(series.at(series.grid(rate)).q, bounds).all())


def free_series(bounds: Bounds, harmonics: int, period: float, rng: np.random.Generator) -> Series:
    """A random series that the arm can take.  Raises OptionError where none is found."""
    room, n = bounds.room, len(bounds.speed)
    centres = rng.uniform(room.lower, room.upper, (POSES, n))
    k = np.arange(1.0, harmonics + 1.0)[:, None]  # as much speed in each harmonic
    for centre in centres[free(centres, bounds)][:IN_VAIN]:
        a, b = at_rest(*(rng.normal(size=(2, harmonics, n)) / k))
        found = shrunk(as_large(Series(centre, a, b, period), bounds), bounds)
        if found is not None:
            return found
    raise OptionError(
        f"{room.robot.name}: no motion found that stays within the limits and the box; make "
        "volume= larger, or give floor= or joints="
    )


def shrunk(series: Series, bounds: Bounds, rate: float = POINTS_HZ) -> Series | None:
    """The series, as small as it must be to be free; None where little is left of it."""
    share = 1.0
    while share > LEAST_SHARE:
        if is_free(series.sized(share), bounds, rate):
            return series.sized(share)
        share *= SHRINKS
    return None


def improved(
    series: Series,
    bounds: Bounds,
    worth: Callable[[Series], float],
    rounds: int,
    rng: np.random.Generator,
) -> Series:
    """A series of more worth, by random steps that become smaller [1+1 evolution]."""
    room, best, value, step = bounds.room, series, worth(series), 0.3
    for _ in range(rounds):
        spread = step * max(float(np.abs(best.a).max()), float(np.abs(best.b).max()))
        k = np.arange(1.0, len(best.a) + 1.0)[:, None]
        a, b = (c + spread / k * rng.normal(size=c.shape) for c in (best.a, best.b))
        away = 0.1 * step * (room.upper - room.lower)
        centre = best.centre + away * rng.normal(size=len(away))
        centre = np.clip(centre, room.lower, room.upper)
        tried = shrunk(as_large(Series(centre, *at_rest(a, b), best.period), bounds), bounds)
        size = -np.inf if tried is None else worth(tried)
        if tried is not None and size > value:
            best, value, step = tried, size, min(1.3 * step, 1.0)
        else:
            step = max(0.95 * step, 0.02)
    return best

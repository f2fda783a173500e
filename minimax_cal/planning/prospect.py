"""What measuring a pose would tell about the parameters of a cell, before it is measured.

The information of a pose is J'V^-1 J over the identifiable parameters, all targets seen there
together.  V = diag(s^2) + t^2 S S': the instrument's noise s, growing with range, and the joints'
jitter t, S being the motion of the targets per unit of each joint (as in `noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from minimax_cal.fitting import identify
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Fact
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import Fitted
from minimax_cal.modelling.effects.table import terms as terms_of
from minimax_cal.modelling.joint_fit import model_at
from minimax_cal.modelling.model import model_of
from minimax_cal.planning.promise import MICRO
from minimax_cal.robots.transforms import shift

SAMPLE = 1000  # poses that tell which parameters are identifiable
CHUNK = 2048  # poses whose Jacobian of all parameters is kept at a time


@dataclass(frozen=True)
class Instrument:
    """Noise of each coordinate, its growth with range, and jitter of each joint [m, -, rad or m].

    The defaults are a laser tracker's data sheet, and an arm that stops to 0.01 mrad.
    """

    noise: Annotated[float, MICRO] = 10e-6
    per_metre: Annotated[float, Fact(key="noise_um_per_m", scale=1e6)] = 2.5e-6
    jitter: Annotated[float, Fact(scale=1e6, unit="urad")] = 10e-6


@dataclass(frozen=True, eq=False)
class Prospect:
    """A cell and what poses can tell about it.

    active: (p,) parameters that these poses identify; f of them.  names: of those.
    scale: (f,) root mean square motion of a target per unit of each [m per unit]: every matrix
    here is in parameters times their scale, which are metres.
    """

    cell: Cell
    instrument: Instrument
    active: Array
    names: tuple[str, ...]
    scale: Array

    def rows(self, data: Measurements, seen: Array) -> Array:
        """(m, 3k, f) Jacobian over noise, 0 where a target is not seen.  seen: (m, k)."""
        out = [
            self.some_rows(data.take(np.arange(start, min(start + CHUNK, data.poses))),
                           seen[start : start + CHUNK])
            for start in range(0, data.poses, CHUNK)
        ]  # fmt: skip
        return np.concatenate(out) if out else np.zeros((0, 3 * seen.shape[1], len(self.names)))

    def some_rows(self, data: Measurements, seen: Array) -> Array:
        """`rows` of few poses."""
        k = seen.shape[1]
        jacobian, scene = motions(self.cell, data)
        told = np.repeat(seen, 3, axis=1)
        swing = np.moveaxis(scene.jacobian, (3, 1, 2, 0), (0, 1, 2, 3))
        swing = swing.reshape(len(seen), 3 * k, -1) * told[..., None]
        away = np.linalg.norm(scene.points - scene.instrument[:, None], axis=1).T
        spread = self.instrument.noise + self.instrument.per_metre * away
        cov = self.instrument.jitter**2 * swing @ np.swapaxes(swing, 1, 2)
        cov[:, np.arange(3 * k), np.arange(3 * k)] += np.repeat(spread**2, 3, axis=1)
        scaled = jacobian.reshape(len(seen), 3 * k, -1)[..., self.active] / self.scale
        return np.asarray(np.linalg.solve(np.linalg.cholesky(cov), scaled * told[..., None]))

    def ahead(self, q: Array, seen: Array) -> Array:
        """`rows` of poses that may be measured.  q: (m, n)."""
        return self.rows(still(q, self.cell.target_names, self.cell.robot), seen)

    def known(self, data: Measurements) -> Array:
        """(f, f) information of poses that were measured."""
        chosen = [self.cell.target_names.index(name) for name in data.target_names]
        seen = np.zeros((data.poses, len(self.cell.target_names)), dtype=bool)
        seen[:, chosen] = data.seen
        flat = self.rows(data, seen).reshape(-1, len(self.names))
        return np.asarray(flat.T @ flat)

    def jacobian(self, q: Array, seen: Array) -> Array:
        """(N, f) of every coordinate that is seen at poses (m, n), without noise: no unit."""
        moved, _ = motions(self.cell, still(q, self.cell.target_names, self.cell.robot))
        return np.asarray(moved[seen].reshape(-1, moved.shape[-1])[:, self.active] / self.scale)

    def predictions(self, q: Array) -> Array:
        """B (m, 3k, f): tr(B C B') is a pose's variance of position, the mean of its targets."""
        moved, _ = motions(self.cell, still(q, self.cell.target_names, self.cell.robot))
        k = moved.shape[1]
        flat = moved.reshape(len(q), 3 * k, -1)[..., self.active]
        return np.asarray(flat / self.scale / np.sqrt(k))


def motions(cell: Cell, data: Measurements) -> tuple[Array, Scene]:
    """Derivative of every target by every parameter, (m, k, 3, p) in base axes, and the scene."""
    model, state = model_at(cell, data)
    jacobian = model.jacobian(state)
    return np.asarray(jacobian), cell.scene(data)


def prospect(cell: Cell, instrument: Instrument, q: Array, seen: Array) -> Prospect:
    """What poses (m, n) can tell of a cell.  seen: (m, k).

    Parameters are identified as in a calibration; of many poses the first thousand tell which.
    """
    q, seen = q[:SAMPLE], seen[:SAMPLE]
    robot = cell.robot
    model, state = model_at(cell, q)
    model = replace(model, weight=seen.T.astype(float))
    names = model.names
    plain = model_of(robot, still(q, cell.target_names, robot))
    order = identify.drop_order(robot, plain.names)
    found = identify.identify(
        model,
        state,
        np.concatenate([np.arange(names.geometric, names.count), order]),
        allowed=np.ones(names.count, dtype=bool),
        reference=identify.plenty_of_poses(robot, plain),
        known=np.zeros(names.count, dtype=bool),
    )
    active = found.active
    kept = tuple(name for name, free in zip(names.all, active, strict=True) if free)
    return Prospect(cell, instrument, active, kept, found.scale[active])


def with_effects(cell: Cell, texts: Sequence[str], q: Array) -> Cell:
    """The cell with further effects whose size is not known yet; their laws are as at poses (m, n).

    Raises OptionError.
    """
    known = [term.label for term in cell.effects.terms]
    scene = cell.scene(still(q[:SAMPLE], cell.target_names, cell.robot))
    terms = [term for term in terms_of(scene, texts) if term.label not in known]
    nothing = [np.zeros(len(term.columns(scene).names)) for term in terms]
    both = Fitted((*cell.effects.terms, *terms), (*cell.effects.values, *nothing))
    return replace(cell, effects=both)


def cell_ahead(cell: Cell, place: Array) -> Cell:
    """A cell whose measurement frame has the base's axes and its origin at a place (3,) [m]."""
    return Cell(cell.robot, shift(*-place), cell.target_names, cell.target_positions, cell.effects)


def ring(count: int, radius: float = 0.1) -> Array:
    """(k, 3) targets on a circle about the flange's axis, as `simulate` has them [m]."""
    angle = 2.0 * np.pi * np.arange(count) / count
    flat = np.stack([np.cos(angle), np.sin(angle), np.full(count, 0.3)], axis=1)
    return np.asarray(radius * flat)


def front(cell: Cell, distance: float) -> Array:
    """(3,) a place before the arm as it points at joint values 0, at half its reach's height [m].

    Where it points up, along the base's x.
    """
    up = cell.robot.up
    flange = cell.robot.pose(np.zeros((1, cell.robot.joints)))[0, :3, 3]
    level = flange - up * (up @ flange)
    if np.linalg.norm(level) < 0.05 * cell.robot.reach():
        level = np.eye(3)[0] - up * up[0]
    if np.linalg.norm(level) < 0.1:
        level = np.eye(3)[1] - up * up[1]
    return np.asarray(distance * level / np.linalg.norm(level) + 0.5 * cell.robot.reach() * up)

"""The measurement model of pixels: where a camera sees a corner, and the derivatives of that.

A target w stands still in the base and the camera rides on the flange, or the target rides and the
camera stands.  With the flange (R, o), and the camera (Rc, tc) in what it is fixed to, the target
in the camera's axes is p = Rc' (R' (w - o) - tc), or p = Rc' (R w + o - tc); its pixel is the
lens's of p.  At given depths z the error (p_xy - u p_z) f / z, u the direction that was seen, is
exactly affine in all lengths: the problem is separable (`Sight`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from minimax_cal.fitting.pixels.camera import INTRINSICS, Camera, distorted, slopes
from minimax_cal.fitting.pixels.data import PixelData
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Prior
from minimax_cal.modelling.parameters import Names
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import Chain
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import solve_normal

AXES = ("x", "y", "z", "rx", "ry", "rz")
LENS = len(INTRINSICS)


@dataclass(frozen=True, eq=False)
class Scene:
    """An arm, cameras and targets; B of them.

    mdh: (B, n, 5) [m, rad].  turn (B, c, 3, 3), place (B, c, 3): poses of the cameras in the flange
    or in the base [m].  board_turn (B, 3, 3), board_place (B, 3): of the board in the base or in
    the flange.  points: (B, k, 3) targets of unknown place there, (B, 0, 3) with a board [m].
    lens: (B, c, 9) `INTRINSICS` of the cameras.
    """

    mdh: Array
    turn: Array
    place: Array
    board_turn: Array
    board_place: Array
    points: Array
    lens: Array

    def take(self, rows: Array) -> Scene:
        """Some members of the batch."""
        return Scene(*(getattr(self, field.name)[rows] for field in fields(self)))

    def put(self, rows: Array, other: Scene) -> Scene:
        """The batch with some members replaced."""
        parts = [getattr(self, field.name).copy() for field in fields(self)]
        for part, field in zip(parts, fields(self), strict=True):
            part[rows] = getattr(other, field.name)
        return Scene(*parts)

    def values(self) -> Array:
        """(own,) cameras' places and turns, the board's or the targets' places, and lenses.

        Of the first member; turns as rotation vectors.
        """
        turns = [kinematics.rotation_vector(turn) for turn in self.turn[0]]
        cameras = [part for pair in zip(self.place[0], turns, strict=True) for part in pair]
        board = [self.board_place[0], kinematics.rotation_vector(self.board_turn[0])]
        spots = [self.points[0].reshape(-1)] if self.points.shape[1] else board
        return np.concatenate([*cameras, *spots, self.lens[0].reshape(-1)])


def names_of(robot: Robot, data: PixelData) -> Names:
    """All parameters: the robot's links, a base that is none of them, cameras, targets, lenses."""
    cameras = [f"camera_{camera.name}" for camera in data.cameras]
    own = [f"{camera}_{axis}" for camera in cameras for axis in AXES]
    if len(data.board):
        own += [f"board_{axis}" for axis in AXES]
    else:
        own += [f"target_{target}_{axis}" for target in data.targets for axis in AXES[:3]]
    own += [f"{camera}_{each}" for camera in cameras for each in INTRINSICS]
    return Names.of(robot, (), tuple(own))


def units_of(names: Names) -> tuple[str, ...]:
    """(p,) SI; pixels where a lens has them."""
    out = list(names.units)
    for i in range(names.geometric, names.count):
        ending = names.all[i].rpartition("_")[2]
        lens = names.all[i].startswith("camera_") and ending in INTRINSICS
        out[i] = "rad" if ending in AXES[3:] else "m"
        if lens:
            out[i] = "px" if ending in INTRINSICS[:4] else ""
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Sight:
    """What errors are taken in: pixels, or (where depth is given) lengths scaled to pixels.

    depth: (N,) of each target in the camera's axes [m].  direction: (2, N) that was seen.
    """

    depth: Array
    direction: Array


@dataclass(frozen=True, eq=False)
class PixelModel:
    """Pixels as a least-squares problem over the active parameters, for `solvers.least_squares`.

    q: (m, n) joint values with signs applied.  prismatic: (n,).  on_flange: whether the cameras
    ride.  board: (k, 3) or (0, 3) [m].  intrinsic: (c, 16) as their files say.
    pose, camera, target: (N,).  pixel: (N, 2) [px].  weight: (N,).
    names: all p parameters; active: (p,) True where one is free.  prior: on the parameters.
    sight: None for pixels.  flange: axes (3, 3, m), one a row, and origin (3, m) of it where
    these are given [m].
    """

    q: Array
    prismatic: Array
    on_flange: bool
    board: Array
    intrinsic: Array
    pose: Array
    camera: Array
    target: Array
    pixel: Array
    weight: Array
    names: Names
    active: Array
    prior: Prior
    sight: Sight | None = None
    flange: tuple[Array, Array] | None = None

    @staticmethod
    def of(robot: Robot, data: PixelData, on_flange: bool) -> PixelModel:
        """All pixels of the data, alike, every parameter free and without a prior."""
        names = names_of(robot, data)
        return PixelModel(
            q=robot.turned(data.at.q),
            prismatic=robot.prismatic,
            on_flange=on_flange,
            board=data.board,
            intrinsic=np.stack([camera.intrinsic for camera in data.cameras]),
            pose=data.pose,
            camera=data.camera,
            target=data.target,
            pixel=data.pixel,
            weight=np.ones(data.count),
            names=names,
            active=np.ones(names.count, dtype=bool),
            prior=Prior(np.zeros(names.count), np.zeros(names.count)),
        )

    # ---- what the solver asks ----------------------------------------------------------------

    @cached_property
    def linear(self) -> Array:
        """(free,) True for the lengths, in which the error at given depths is affine."""
        names, n = self.names, (self.q.shape[1])
        mask = np.zeros(names.count, dtype=bool)
        mask[: 2 * n] = True
        for i in range(names.geometric, names.count):
            mask[i] = names.all[i].rpartition("_")[2] in AXES[:3]
        return np.asarray(mask[self.active])

    def normal(self, x: Scene) -> tuple[Array, Array, Array]:
        """Cost (B,), gradient (B, free) and Gram matrix (B, free, free)."""
        every = [self.normal_of(x.take(np.array([i]))) for i in range(len(x.mdh))]
        cost, gradient, gram = zip(*every, strict=True)
        return np.array(cost), np.stack(gradient), np.stack(gram)

    def normal_of(self, x: Scene) -> tuple[float, Array, Array]:
        """`normal` of a batch of one."""
        error, jacobian = self.rows(x, self.active)
        root = np.sqrt(self.weight)
        error, jacobian = (error * root).reshape(-1), (jacobian * root).reshape(-1, error.size)
        weight = self.prior.weight[self.active]
        off = (self.prior.mean - self.values(x))[self.active]
        cost = float(error @ error + weight @ off**2)
        gram = jacobian @ jacobian.T + np.diag(weight)
        return cost, jacobian @ error + weight * off, gram

    def reduced(self, x: Scene, *, full: bool) -> tuple[Scene, Array, Array, Array, Array]:
        """The scenes with their best lengths; Kaufman's variant, which needs no coupling."""
        cost, gradient, gram = self.normal(x)
        r = self.linear
        move = np.zeros(gradient.shape)
        move[:, r] = solve_normal(gram[:, r][:, :, r], gradient[:, r, None])[..., 0]
        x = self.step(x, move)
        cost, gradient, gram = self.normal(x)
        return x, cost, gradient, gram, np.zeros((len(cost), int(r.sum()), int((~r).sum())))

    def step(self, x: Scene, dx: Array) -> Scene:
        """The scenes moved by a step (B, free); turns about the own axes of what turns."""
        whole = np.zeros((len(dx), self.names.count))
        whole[:, self.active] = dx
        n, c, b = self.q.shape[1], len(self.intrinsic), len(dx)
        links = np.swapaxes(whole[:, : 5 * n].reshape(b, 5, n), -1, -2)
        cameras, spots, lens = self.split(whole[:, self.names.geometric :])
        cameras = cameras.reshape(b, c, 6)
        moved = replace(
            x,
            mdh=x.mdh + links,
            place=x.place + cameras[..., :3],
            turn=x.turn @ kinematics.rotation(cameras[..., 3:]),
            lens=x.lens + lens.reshape(b, c, LENS),
        )
        if not len(self.board):
            return replace(moved, points=x.points + spots.reshape(b, -1, 3))
        return replace(
            moved,
            board_place=x.board_place + spots[:, :3],
            board_turn=x.board_turn @ kinematics.rotation(spots[:, 3:]),
        )

    def split(self, own: Array) -> tuple[Array, Array, Array]:
        """Parts (..., own) of cameras' poses, of board or targets, and of lenses."""
        c = len(self.intrinsic)
        return own[..., : 6 * c], own[..., 6 * c : -LENS * c], own[..., -LENS * c :]

    def values(self, x: Scene) -> Array:
        """(p,) all parameters of a batch of one that a prior may know: links and lenses."""
        out = np.zeros(self.names.count)
        out[: 5 * self.q.shape[1]] = x.mdh[0].T.reshape(-1)
        out[-x.lens[0].size :] = x.lens[0].reshape(-1)
        return out

    # ---- rows --------------------------------------------------------------------------------

    def lenses(self, x: Scene) -> Array:
        """(16, N) numbers of each pixel's camera."""
        every = np.concatenate([x.lens[0], self.intrinsic[:, LENS:]], axis=1)
        return np.asarray(every[self.camera].T)

    def seen(self, x: Scene) -> Seen:
        """Where the targets of a batch of one are."""
        links = kinematics.chain(x.mdh[0], self.q, self.prismatic)
        spots = x.points[0]
        if len(self.board):
            spots = self.board @ x.board_turn[0].T + x.board_place[0]
        own = spots[self.target].T
        axes, origin = self.flange or (links.axes, links.origin)
        axes, origin = axes[..., self.pose], origin[:, self.pose]
        if self.on_flange:
            base, fixed = own, np.einsum("ijn,jn->in", axes, own - origin)
        else:
            base = np.einsum("ijn,in->jn", axes, own) + origin
            fixed = base
        view = np.moveaxis(x.turn[0], 1, 2)[self.camera].transpose(1, 2, 0)  # Rc', (3, 3, N)
        point = np.einsum("ijn,jn->in", view, fixed - x.place[0][self.camera].T)
        return Seen(links, axes, base, view, point)

    def predicted(self, x: Scene) -> Array:
        """(2, N) pixels of a batch of one, and depths are those of `seen`."""
        point = self.seen(x).point
        return distorted(self.lenses(x), point[0] / point[2], point[1] / point[2])

    def errors(self, x: Scene) -> Array:
        """(2, N) measured minus predicted pixels of a batch of one [px]."""
        return np.asarray(self.pixel.T - self.predicted(x))

    def rows(self, x: Scene, active: Array) -> tuple[Array, Array]:
        """Measured minus predicted (2, N) [px], and the derivative of the predicted (free, 2, N).

        active: (p,).
        """
        seen = self.seen(x)
        moved, lens = self.motion(x, seen, active)
        point = seen.point
        if self.sight is not None:
            focal = self.intrinsic[self.camera, :2].T / self.sight.depth
            direction = self.sight.direction
            error = -focal * (point[:2] - direction * point[2])
            slope = focal * (moved[:, :2] - direction * moved[:, 2:])
            return error, np.concatenate([slope, np.zeros((len(lens), *error.shape))])
        pixel, by, own = slopes(self.lenses(x), *(point[:2] / point[2]))
        slope = imaged(seen, by, moved)
        mine = own[lens % LENS] * (self.camera == lens[:, None] // LENS)[:, None, :]
        return self.pixel.T - pixel, np.concatenate([slope, mine])

    def bearings(self, x: Scene, active: Array) -> Array:
        """(free, 3, N) how the directions to the targets turn, wherever a camera looks [rad].

        Lenses turn nothing.
        """
        seen = self.seen(x)
        moved, lens = self.motion(x, seen, active)
        return np.concatenate([turned(seen, moved), np.zeros((len(lens), 3, len(self.pose)))])

    def by_place(self, seen: Seen) -> Array:
        """(3, 3, N) slopes of the targets in the cameras' axes by the flange's place."""
        if not self.on_flange:
            return seen.view
        return np.asarray(-np.einsum("ijn,jkn->ikn", seen.view, seen.axes))

    def motion(self, x: Scene, seen: Seen, active: Array) -> tuple[Array, Array]:
        """Derivative (free - lenses, 3, N) of the targets in the cameras' axes, and which lenses.

        Lenses (l,) are numbers of camera and intrinsic: camera * 9 + intrinsic.
        """
        names, n = self.names, self.q.shape[1]
        cameras, spots, lens = self.split(active[names.geometric :])
        arm = self.by_place(seen)
        spot = -arm if self.on_flange else np.einsum("ijn,kjn->ikn", arm, seen.axes)
        parts = [turned_by(arm, swing(seen, self.pose, active[: 5 * n]))]
        parts += self.by_cameras(seen, cameras)
        parts += self.by_board(x, spot, spots) if len(self.board) else self.by_points(spot, spots)
        return np.concatenate(parts), np.flatnonzero(lens)

    def by_cameras(self, seen: Seen, active: Array) -> list[Array]:
        """Derivatives (1, 3, N) by the cameras' poses."""
        out = []
        for each in np.flatnonzero(active):
            camera, axis = divmod(int(each), 6)
            mine = self.camera == camera
            if axis < 3:
                slope = -seen.view[:, axis]
            else:
                slope = kinematics.cross(seen.point, np.eye(3)[axis - 3][:, None])
            out.append((slope * mine)[None])
        return out

    def by_board(self, x: Scene, from_spot: Array, active: Array) -> list[Array]:
        """Derivatives (1, 3, N) by the board's pose."""
        turn, local = x.board_turn[0], self.board[self.target].T
        out = []
        for axis in np.flatnonzero(active):
            if axis < 3:
                out.append(from_spot[:, axis][None])
                continue
            about = kinematics.cross(np.eye(3)[axis - 3][:, None], local)
            out.append(np.einsum("ijn,jn->in", from_spot, turn @ about)[None])
        return out

    def by_points(self, from_spot: Array, active: Array) -> list[Array]:
        """Derivatives (1, 3, N) by the places of targets."""
        chosen = np.flatnonzero(active)
        out = np.zeros((len(chosen), 3, len(self.pose)))
        for row, each in enumerate(chosen):
            mine = np.flatnonzero(self.target == each // 3)
            out[row][:, mine] = from_spot[:, each % 3, mine]
        return [out]


@dataclass(frozen=True, eq=False)
class Seen:
    """The arm at its poses, and the N targets in its base and in the cameras.

    axes: (3, 3, N) of the flange, one a row.  base, point: (3, N) in the base and in the camera's
    axes [m].  view: (3, 3, N) rotation into the camera from what it is fixed to.
    """

    links: Chain
    axes: Array
    base: Array
    view: Array
    point: Array


def swing(seen: Seen, pose: Array, active: Array) -> Array:
    """(free, 3, N) motion, in the base, of the targets as if fixed to the flange.

    active: (5n,) link parameters.
    """
    n = len(active) // 5
    links = seen.links
    slides = np.concatenate([links.x, links.z])[active[: 2 * n]][..., pose]
    axis, moment = (part[active[2 * n :]][..., pose] for part in kinematics.screws(links))
    turns = moment - kinematics.cross(seen.base, axis)
    return np.concatenate([slides, turns])


def imaged(seen: Seen, by: Array, moved: Array) -> Array:
    """(p, 2, N) how pixels move, by their slopes and the targets' motions (p, 3, N) [px]."""
    flat = (moved[:, :2] - seen.point[:2] / seen.point[2] * moved[:, 2:]) / seen.point[2]
    return np.asarray(flat[:, :1] * by[0] + flat[:, 1:] * by[1])


def turned(seen: Seen, moved: Array) -> Array:
    """(p, 3, N) how directions turn, by the targets' motions (p, 3, N) [rad]."""
    size = np.linalg.norm(seen.point, axis=0)
    unit = seen.point / size
    return np.asarray((moved - np.einsum("pin,in->pn", moved, unit)[:, None] * unit) / size)


def turned_by(rotation: Array, rows: Array) -> Array:
    """Rows (p, 3, N), each turned by the rotation (3, 3, N) of its pixel."""
    out = np.empty_like(rows)
    for i in range(3):
        out[:, i] = sum(rotation[i, j] * rows[:, j] for j in range(3))
    return out


def lens_of(cameras: Sequence[Camera]) -> Array:
    """(1, c, 9) of the cameras, as their files say."""
    return np.stack([camera.intrinsic[:LENS] for camera in cameras])[None]

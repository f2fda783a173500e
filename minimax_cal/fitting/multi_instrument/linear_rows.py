"""What several instruments leave, linear where their fit ended: the rows of a problem of evidence.

Each row is weighed by its instrument's noise.  The rows of a pose are rotated so that the noise of
the joints is diagonal, as `modelling.rows` does it.  Geometry, what each instrument has of its own,
and the places of sockets are projected out.  By how much a law turns and moves the flange is told
by the motions of four corners about what each instrument looks at, as in its fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.multi_instrument.instrument_fit import InstrumentFit
from minimax_cal.fitting.multi_instrument.instrument_stack import row_index_in_pose
from minimax_cal.instruments.protocol import (
    EffectMotion,
    FlangePoses,
    ResidualRows,
    flange_corners,
    slopes_by_arm_parameters,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.error_rows import MAX_COMPUTED_POINT_NOISE, PoseRows
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import orthonormal_basis

NOISE_SEPARATION_RATIO = (
    2.0  # times the largest spread of joints: eigenvalues of rows that hold no number
)


@dataclass(frozen=True, eq=False)
class LinearInstrument:
    """An instrument where a fit ended.

    rows: as it reads there.  flange: at its m poses.  middle: (3,) of the corners, on it [m].
    root: (rows,) what each is multiplied by.  poses: which of all poses are its own.  cell: (rows,)
    place of each among all, pose by pose.  shapeless: (m, r, r) see `Instrument.shapeless`.
    """

    rows: ResidualRows
    flange: FlangePoses
    middle: Array
    root: Array
    poses: slice
    cell: Array
    shapeless: Array

    def rows_from_fields(self, fields: Array) -> Array:
        """(d, rows) motions (d, 4, 3, m) of its corners as its rows."""
        still, none = np.zeros(fields.shape[1:]), np.zeros(len(fields))
        given = EffectMotion.from_corner_motions(self.flange, self.middle, fields, still, none)
        moved = self.flange._replace(angular=given.angular, linear=given.linear)
        slopes = slopes_by_arm_parameters(moved, self.rows)
        return np.asarray(
            self.rows.eliminate_places_and_add_sums(slopes, keep_slopes=True)[1] * self.root
        )


@dataclass(frozen=True, eq=False)
class InstrumentRows(PoseRows):
    """Rows of several instruments; looks: at each."""

    looks: tuple[LinearInstrument, ...]

    def rows_from_fields(self, displacement_fields: Array) -> Array:
        """(N, D) motions (D, 4, 3, m) of the corners at the poses of all instruments, as rows."""
        d, (m, r) = len(displacement_fields), self.weight.shape
        out = np.zeros((d, m * r))
        for look in self.looks:
            out[:, look.cell] = look.rows_from_fields(displacement_fields[..., look.poses])
        return self.rotate_rows(out)

    def rotate_rows(self, rows: Array) -> Array:
        """(N, D) rows (D, N), pose by pose, in the axes of each pose."""
        m, r = self.weight.shape
        flat = np.moveaxis(rows.reshape(-1, m, r), 1, 0) @ self.turn
        return np.asarray(flat.swapaxes(1, 2).reshape(m * r, -1))


def build_common_arm_state(robot: Robot, fit: InstrumentFit) -> PosedArm:
    """All poses that any instrument saw, each with its corners, in the frame of the base."""
    stack, x = fit.stack, fit.state
    every = [
        one.build_arm_state(robot, at, flange_corners(one.centre_of_targets(at)))
        for one, at in stack.blocks_with_states(x)
    ]
    points = np.concatenate([one.points for one in every], axis=-1)
    q = np.concatenate([block.arm.q for block in stack.blocks])
    links = kinematics.compute_link_frames(x.mdh, q, robot.prismatic)
    return PosedArm(
        robot.with_mdh(x.mdh), join_poses([one.data for one in every]), links,
        every[0].target_positions, points, np.eye(3), np.zeros(3),
    )  # fmt: skip


def join_poses(seen: list[Measurements]) -> Measurements:
    """The poses of all files, with the numbers that any of them tells."""
    count = [len(each.q) for each in seen]
    columns = {
        name: np.concatenate([
            each.columns.get(name, np.full(m, np.nan)) for each, m in zip(seen, count, strict=True)
        ])
        for name in dict.fromkeys(name for each in seen for name in each.columns)
        if all(each.columns.get(name, np.zeros(0)).dtype.kind == "f" for each in seen)
    }  # fmt: skip
    first, total = seen[0], sum(count)
    return replace(
        first,
        q=np.concatenate([each.q for each in seen]),
        y=np.zeros((total, 0, 3)),
        target_names=(),
        line=np.arange(total) + 1,
        columns=columns,
        unknown={},
        aside=None,
        source=", ".join(each.source for each in seen),
    )


def build_instrument_rows(scene: PosedArm, fit: InstrumentFit) -> InstrumentRows:
    """The rows of all instruments.  scene: `build_common_arm_state`; fit: of geometry alone."""
    stack, active = fit.stack, fit.identification.active
    starts = np.cumsum([0, *(len(block.arm.q) for block in stack.blocks)]).tolist()
    read = [block.read_residual_rows(at) for block, at in stack.blocks_with_states(fit.state)]
    slots = [row_index_in_pose(rows.pose_of_each_row) for rows in read]
    width = max(int(slot.max()) + 1 for slot in slots)
    looks, errors, slopes, places = [], [], [], []
    every = zip(stack.blocks, read, slots, np.sqrt(stack.precision), starts, strict=False)
    for i, (block, rows, slot, precise, start) in enumerate(every):
        x, columns = stack.state_of_block(fit.state, i), stack.block_columns(i)
        root = (
            precise * block.weight / np.sqrt(rows.row_weights)
        )  # no error beyond the loss's bound
        flange, own = block.flange_and_own_values(x)
        shapeless = block.instrument.projectors_on_empty_rows(flange, own)
        at = (start + rows.pose_of_each_row) * width + slot
        poses = slice(start, start + len(block.arm.q))
        looks.append(
            LinearInstrument(rows, flange, block.centre_of_targets(x), root, poses, at, shapeless)
        )
        error, slope = block.rows(x, active[columns], loose=True)
        whole = np.zeros((len(active), len(root)))
        whole[columns[active[columns]]] = slope * root
        errors.append(error * root)
        slopes.append(whole)
        places.append(rows.slopes_by_eliminated_places * root)
    return assemble_rows_by_pose(scene, fit, looks, errors, slopes, places, width)


def assemble_rows_by_pose(
    scene: PosedArm,
    fit: InstrumentFit,
    looks: list[LinearInstrument],
    errors: list[Array],
    slopes: list[Array],
    places: list[Array],
    width: int,
) -> InstrumentRows:
    """Rows pose by pose, each pose turned so that joints and instruments err independently.

    errors: (rows,), slopes: (p, rows), places: (q, rows) of what was eliminated, of each block.
    """
    total = scene.poses * width
    error, nuisance = np.zeros((1, total)), np.zeros((len(slopes[0]), total))
    real, dead = np.zeros(total, dtype=bool), np.zeros((scene.poses, width, width))
    beside = []
    for look, e, slope, more in zip(looks, errors, slopes, places, strict=True):
        error[0, look.cell], nuisance[:, look.cell] = e, slope
        real[look.cell] = np.any(slope, axis=0) | np.any(more, axis=0)
        own = np.zeros((len(more), total))
        own[:, look.cell] = more
        beside.append(own)
        shape = look.shapeless
        dead[look.poses, : shape.shape[1], : shape.shape[1]] = shape
    arms = np.zeros((scene.joints, total))
    for look in looks:
        arms[:, look.cell] = look.rows_from_fields(scene.jacobian[..., look.poses])
    by_pose = np.moveaxis(arms.reshape(scene.joints, scene.poses, width), 0, -1)
    spread = by_pose @ np.swapaxes(by_pose, 1, 2)
    far = NOISE_SEPARATION_RATIO * max(float(np.trace(spread, axis1=1, axis2=2).max()), 1.0)
    hidden = dead + np.einsum("mr,rs->mrs", ~real.reshape(-1, width), np.eye(width))
    values, turn = np.linalg.eigh(spread - far * hidden)
    values, measured = np.maximum(values, 0.0).reshape(-1), (values > -0.5 * far).reshape(-1)
    size = max(float(values.sum()) / max(int(measured.sum()), 1), 1e-300)
    bare = InstrumentRows(
        error=np.zeros(0),
        nuisance_basis=np.zeros((0, 0)),
        variance_ratio=values / size,
        mean_variance_ratio=size,
        row_groups=np.repeat(number_poses(fit), width),
        measured=measured,
        rounding_noise=MAX_COMPUTED_POINT_NOISE,
        turn=turn,
        weight=np.ones((scene.poses, width)),
        looks=tuple(looks),
    )
    rest = bare.rotate_rows(error)[:, 0] * measured
    basis = orthonormal_basis(
        bare.rotate_rows(np.concatenate([nuisance, *beside])) * measured[:, None]
    )
    return replace(bare, error=rest, nuisance_basis=basis)


def number_poses(fit: InstrumentFit) -> Array:
    """(m,) a number, from 0, of each pose; repeats of one in a file have the same."""
    out, count = [], 0
    for data in fit.training_data.values():
        number = group_repeated_poses(data.at)
        out.append(number + count)
        count += int(number.max()) + 1
    return np.concatenate(out)

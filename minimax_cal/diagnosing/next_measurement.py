"""What to measure next, so that two effects which these data confuse can be told apart.

Every proposal is computed as if it had been carried out: its poses are added to those at hand, the
geometry and the other effects are fitted to all of them, and what is left of the named effect's
motion once its rival has imitated it is weighed by the noise of instrument and joints.  All that is
new is measured after what is there: the clock of the session goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import column_norms_from_gram, schur_complement
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import (
    EFFECTS,
    Term,
    effect_displacement_fields,
    session_frame_terms,
)
from minimax_cal.modelling.error_rows import PointRows, build_point_rows
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.robots.transforms import perpendicular_unit_vectors
from minimax_cal.selection.noise_model import Noise, identifiable_combinations
from minimax_cal.selection.thresholds import (
    FULL_JOINT_RANGE_FRACTION,
    MAX_NEGLIGIBLE_POWER,
    MIN_HELPFUL_POWER_FRACTION,
    SUFFICIENT_SEPARATION_POWER,
)

MORE_POSE_COUNTS, REVISIT_POSE_COUNTS = (10, 20, 40, 80), (10, 20, 40)  # poses of a proposal
MINUTES_PER_POSE = 1.0  # to move, settle and measure all targets of a pose [min]
PREPARATION_MINUTES = {
    "more": 0.0,
    "late": 5.0,
    "side": 5.0,
    "load": 15.0,
    "foot": 20.0,
}  # once [min]
GOLDEN_RATIO_FRACTION = 0.6180339887498949
APPROACH_STEP = 0.1  # move by which a pose is approached from its other side [rad, m]
PAYLOAD_MASS_FRACTION = 0.03  # payload that is proposed, as a share of the arm's mass
FOOT_RADIUS_REACH_FRACTION = 0.2  # radius of the reflectors on the foot, as a share of the reach
FITTED_COLUMN_RIDGE = 1e-13  # of a unit column that is fitted: what no pose shows stays finite
MIN_RELATIVE_FIELD_CHANGE = (
    1e-6  # relative change of a field below which a proposal does not concern an effect
)


@dataclass(frozen=True)
class MeasurementAdvice:
    """One further measurement.

    text: for the person who carries it out.  minutes: what it costs, by `MINUTES_PER_POSE` and
    `PREPARATION_MINUTES`. power: lambda (1 - rho^2) on old and new poses together;
    `SUFFICIENT_SEPARATION_POWER` tells the effects apart.
    """

    text: str
    minutes: float
    power: float


@dataclass(frozen=True, eq=False)
class ConfusedEffects:
    """An effect and the rival that data confuse with it.

    effect_values: (d,) what was fitted of the one.  other_effects: other effects that were found,
    with values.
    """

    effect: Term
    effect_values: Array
    alternative: Term
    other_effects: Sequence[tuple[Term, Array]] = ()


@dataclass(frozen=True, eq=False)
class MeasurementPlan:
    """The poses at hand and all that are proposed, one after another.

    data: every row.  weight: (k, m) of its points.  ranges_by_kind: first row and count of each
    kind.
    """

    data: Measurements
    weight: Array
    ranges_by_kind: dict[str, tuple[int, int]]

    def select_plan_rows(self, kind: str, pose_count: int) -> slice:
        """The first so many poses of a kind."""
        start, most = self.ranges_by_kind[kind]
        return slice(start, start + min(pose_count, most))


@dataclass(frozen=True, eq=False)
class MeasurementPlanner:
    """A fitted cell with poses that might be measured; shared by all pairs of effects.

    scene: of the poses at hand, with their history.  model, state: the geometry fitted to them.
    noise: of instrument and joints.
    """

    scene: PosedArm
    model: PointModel
    state: ParameterValues
    noise: Noise
    seed: int = 0

    @cached_property
    def measurement_plan(self) -> MeasurementPlan:
        """What may be measured."""
        return plan_measurements(self.scene, self.model.weight, np.random.default_rng(self.seed))

    @cached_property
    def planned_arm(self) -> PosedArm:
        """The scene of all rows of the plan."""
        robot, base = self.scene.robot, (self.scene.rotation, self.scene.origin)
        data = self.measurement_plan.data
        return PosedArm.at_measured_poses(
            robot, data, base, self.scene.target_positions, robot.chain_joint_values(data.q)
        )

    @cached_property
    def row_rotations(self) -> PointRows:
        """Rotations of the rows that make both noises diagonal."""
        k, _, m = self.planned_arm.points.shape
        nothing = np.zeros((k, 0, 3, m))
        return build_point_rows(
            np.zeros((k, 3, m)), nothing, self.planned_arm.jacobian, self.measurement_plan.weight
        )

    @cached_property
    def row_weight_roots(self) -> Array:
        """(N,) square roots of the weights of rows [1/m]."""
        joints = (
            self.noise.joint_jitter**2
            * self.row_rotations.variance_ratio
            * self.row_rotations.mean_variance_ratio
        )
        return np.asarray(1.0 / np.sqrt(self.noise.variance + joints))

    @cached_property
    def geometry_columns(self) -> Array:
        """(N, p) how every row follows the geometry [m per unit]."""
        k, _, m = self.planned_arm.points.shape
        model = replace(
            self.model,
            q=self.scene.robot.chain_joint_values(self.measurement_plan.data.q),
            y=np.zeros((k, 3, m)),
            weight=self.measurement_plan.weight,
        )
        if free := session_frame_terms(self.measurement_plan.data.frames):
            fields = effect_displacement_fields(free, self.planned_arm)
            model = replace(model, fields=fields, moved=np.zeros((0, 0, 0)))
        return self.row_rotations.rows_from_fields(
            np.moveaxis(model.point_jacobian(self.state), (3, 0), (0, 3))
        )

    def pose_row_slice(self, pose_slice: slice) -> slice:
        """The rows of some poses."""
        per = 3 * self.planned_arm.targets
        return slice(pose_slice.start * per, pose_slice.stop * per)

    @cached_property
    def identifiable_spans(self) -> dict[tuple[str, int], Array]:
        """(p, r) per proposal: the combinations of geometric parameters that can be fitted."""
        gram = {
            key: own.T @ own
            for key in self.proposed_measurements
            for own in [
                self.geometry_columns[
                    self.pose_row_slice(self.measurement_plan.select_plan_rows(*key))
                ]
            ]
        }
        old = gram["old", self.scene.poses]
        return {
            key: identifiable_combinations(old if key[0] in ("old", "foot") else old + gram[key])
            for key in self.proposed_measurements
        }

    @cached_property
    def proposed_measurements(self) -> tuple[tuple[str, int], ...]:
        """Kinds and counts of poses, first the data as they are."""
        sizes = {
            kind: MORE_POSE_COUNTS if kind == "more" else REVISIT_POSE_COUNTS
            for kind in PREPARATION_MINUTES
        }
        listed = [
            (kind, count)
            for kind, counts in sizes.items()
            for count in sorted(
                {min(c, self.measurement_plan.ranges_by_kind[kind][1]) for c in counts}
            )
        ]
        return (("old", self.scene.poses), *listed)


# ---- what might be measured --------------------------------------------------------------------


def plan_measurements(
    scene: PosedArm, point_weights: Array, rng: np.random.Generator
) -> MeasurementPlan:
    """The existing poses, and after them those that are proposed."""
    m, n = scene.poses, scene.joints
    tip, up = scene.points.mean(axis=0), scene.robot.up
    reach = np.linalg.norm(tip - up[:, None] * (up @ tip), axis=0)  # from the vertical at the base
    outer = np.argsort(-reach, kind="stable")[: max(REVISIT_POSE_COUNTS)]
    first = np.argsort(scene.column("clock"), kind="stable")[: max(REVISIT_POSE_COUNTS)]
    old = with_float_columns(scene.data, scene)
    like = rng.integers(
        0, m, max(MORE_POSE_COUNTS)
    )  # which targets are seen, and what is not told below
    some = [old, sample_more_poses(scene, old.take(like), rng)]
    fresh = (
        1.0 + (np.arange(len(outer)) + 0.5) * GOLDEN_RATIO_FRACTION % 1.0
    )  # all over another session
    again = with_changed_columns(old.take(outer), clock=fresh)
    last = {name: again.columns[name] for name in (f"approach{j + 1}" for j in range(n))}
    sides = {name: np.where(side == 0.0, 1.0, -side) for name, side in last.items()}
    moves = {f"move{j + 1}": APPROACH_STEP * sides[f"approach{j + 1}"] for j in range(n)}
    heavier = again.columns["payload"] + propose_payload(scene)
    hung = with_changed_columns(
        again, payload=heavier, **torques_with_payload(scene, outer, propose_payload(scene))
    )
    read = old.columns.get("temperature", np.zeros(0))
    warm: dict[str, Array] = {}
    if np.isfinite(read).any():  # as high as it was
        warm = {"temperature": np.full(len(first), np.nanmax(read))}
    late = with_changed_columns(
        old.take(first), clock=1.0 + (np.arange(len(first)) + 1.0) / m, **warm
    )
    some += [late, again, hung, with_changed_columns(again, **sides, **moves)]
    parts = [point_weights[:, rows] for rows in (np.arange(m), like, first, outer, outer, outer)]
    starts = np.cumsum([0, *(part.poses for part in some)])
    kinds = ("old", "more", "late", "foot", "load", "side")
    at = {
        kind: (int(start), part.poses)
        for kind, start, part in zip(kinds, starts[:-1], some, strict=True)
    }
    return MeasurementPlan(old.append_measurements(*some[1:]), np.concatenate(parts, axis=1), at)


def with_float_columns(data: Measurements, scene: PosedArm) -> Measurements:
    """The data with a payload and whole numbers as floats, so that rows can be changed."""
    columns = {
        name: column.astype(float) if column.dtype.kind in "biuf" else column
        for name, column in data.columns.items()
    }
    return replace(data, columns={**columns, "payload": scene.column("payload")})


def with_changed_columns(data: Measurements, **columns: Array) -> Measurements:
    """The same rows with other columns."""
    return replace(data, columns={**data.columns, **columns})


def propose_payload(scene: PosedArm) -> float:
    """A payload that such an arm surely carries: 1, 2 or 5 times a power of ten [kg]."""
    target = PAYLOAD_MASS_FRACTION * float(scene.link_masses_and_centres[0].sum())
    ten = 10.0 ** np.floor(np.log10(max(target, 0.1)))
    return float(max(step * ten for step in (1.0, 2.0, 5.0) if step * ten <= max(target, ten)))


def torques_with_payload(
    scene: PosedArm, pose_indices: Array, payload_mass: float
) -> dict[str, Array]:
    """Measured torques with a further payload, where torques were measured."""
    if not scene.has_measured_torques:
        return {}
    one = np.ones(scene.poses)
    heavy = with_changed_columns(scene.data, payload=one)
    torque = replace(scene, data=heavy).payload_torques * scene.robot.sign[:, None] * payload_mass
    return {
        f"tau{j + 1}": scene.data.columns[f"tau{j + 1}"][pose_indices] + torque[j, pose_indices]
        for j in range(scene.joints)
        if f"tau{j + 1}" in scene.data.columns
    }


def joint_bounds(scene: PosedArm) -> tuple[Array, Array]:
    """(n,) the joints' limits; where the robot file has none, what the data span."""
    q, robot = scene.data.q, scene.robot
    low, high = q.min(axis=0), q.max(axis=0)
    most = np.where(robot.prismatic, np.inf, np.maximum(np.pi, np.abs(q).max(axis=0)))
    lower = np.where(np.isfinite(robot.lower), np.maximum(robot.lower, -most), low)
    upper = np.where(np.isfinite(robot.upper), np.minimum(robot.upper, most), high)
    return np.minimum(lower, upper), np.maximum(lower, upper)


def sample_more_poses(
    scene: PosedArm, template_poses: Measurements, rng: np.random.Generator
) -> Measurements:
    """Random poses within the bounds, above the floor, about as far from the instrument."""
    robot, count = scene.robot, template_poses.poses
    q = rng.uniform(*joint_bounds(scene), (32 * count, scene.joints))
    flange = robot.pose(q)[:, :3, 3].T
    there = scene.links.origin
    floor = min(0.1 * robot.reach(), float((robot.up @ there).min()))
    seen = np.linalg.norm(there - scene.instrument[:, None], axis=0)
    away = np.linalg.norm(flange - scene.instrument[:, None], axis=0)
    off = np.maximum(floor - robot.up @ flange, 0.0) + np.abs(
        away - np.clip(away, seen.min(), seen.max())
    )
    return append_visits(scene, template_poses, q[np.argsort(off, kind="stable")[:count]])


def append_visits(scene: PosedArm, template_poses: Measurements, q: Array) -> Measurements:
    """Poses (m, n) measured one after another once the data at hand are.

    template_poses: m rows with the columns that the way there does not tell.
    """
    last = scene.data.q[int(np.argmax(scene.column("clock")))]
    move = np.diff(q, axis=0, prepend=last[None])
    history = {f"move{j + 1}": move[:, j] for j in range(scene.joints)}
    history |= {f"approach{j + 1}": np.sign(move[:, j]) for j in range(scene.joints)}
    clock = 1.0 + (np.arange(len(q)) + 1.0) / scene.poses
    moved = replace(
        with_changed_columns(template_poses, **history, clock=clock, followed=np.ones(len(q))), q=q
    )
    return with_changed_columns(moved, **predict_torque_columns(scene, moved))


def predict_torque_columns(scene: PosedArm, planned_poses: Measurements) -> dict[str, Array]:
    """Torques that would be measured at other poses, by the weights that those at hand suggest."""
    if not scene.has_measured_torques:
        return {}
    robot, base = scene.robot, (scene.rotation, scene.origin)
    there = PosedArm.at_measured_poses(
        robot,
        planned_poses,
        base,
        scene.target_positions,
        robot.chain_joint_values(planned_poses.q),
    )
    mass, com = scene.link_masses_and_centres
    links = np.diag(mass)
    known, new = ([s.drive_gravity_torques(one, com) for one in links] for s in (scene, there))
    out = {}
    for j in range(scene.joints):
        if f"tau{j + 1}" in scene.data.columns:
            tau = scene.data.columns[f"tau{j + 1}"]
            old = np.stack([part[j] for part in known] + [np.ones(scene.poses)], axis=1)
            ahead = np.stack([part[j] for part in new] + [np.ones(planned_poses.poses)], axis=1)
            told = np.isfinite(tau)
            out[f"tau{j + 1}"] = ahead @ np.linalg.lstsq(old[told], tau[told], rcond=1e-6)[0]
    return out


# ---- what it would tell ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class EffectMotions:
    """Motions by some effects.

    target_motions: (d, k, 3, m) of the targets at all rows of the plan [m].
    foot_motions: (d, 3, 3, poses) of three points of the foot [m].
    prior_precisions: (d,) inverse variance of what is known of each.
    """

    target_motions: Array
    foot_motions: Array
    prior_precisions: Array


def effect_motions(
    planner: MeasurementPlanner, term: Term
) -> tuple[EffectMotions, EffectMotions, list[int]]:
    """Motion per unit of each parameter; the doubts about it, and the parameter of each."""
    scene, k = planner.planned_arm, planner.scene.targets
    base = EFFECTS[term.effect].moves_base
    if base:  # probes about the targets' centre tell how the law moves any point of the base
        centre = scene.points.mean(axis=0)
        probes = np.concatenate([np.eye(3), -np.eye(3)])[:, :, None] + centre
        scene = replace(scene, points=np.concatenate([scene.points, probes]))
    columns = term.columns(scene)
    doubts, owners = [np.zeros((0, *scene.points.shape))], []
    for owner, part in columns.displacement_uncertainties(scene):
        doubts.append(part)
        owners += [owner] * len(part)
    out = []
    for one in (columns.target_displacements(scene), np.concatenate(doubts)):
        foot = (
            foot_point_motions(planner, one[:, k:], centre)
            if base
            else np.zeros((len(one), 3, 3, 0))
        )
        out.append(EffectMotions(one[:, :k], foot, np.zeros(len(one))))
    return out[0], out[1], owners


def foot_point_motions(planner: MeasurementPlanner, probe_motions: Array, centre: Array) -> Array:
    """(d, 3, 3, poses) motion of three points of the foot.  probe_motions: (d, 6, 3, m) as
    `effect_motions`.
    """
    rows = planner.measurement_plan.select_plan_rows("foot", max(REVISIT_POSE_COUNTS))
    across = perpendicular_unit_vectors(planner.scene.robot.up)
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    feet = (
        FOOT_RADIUS_REACH_FRACTION
        * planner.scene.robot.reach()
        * np.stack([np.cos(angle), np.sin(angle)], 1)
        @ across
    )
    mean = probe_motions[..., rows].mean(axis=1)
    jacobian = 0.5 * (probe_motions[:, :3, :, rows] - probe_motions[:, 3:, :, rows])
    arm = feet[:, :, None] - centre[None, :, rows]
    return np.asarray(mean[:, None] + np.einsum("fam,dacm->dfcm", arm, jacobian))


def fitted_effect_motions(
    planner: MeasurementPlanner, fitted_effects: Sequence[tuple[Term, Array]]
) -> list[EffectMotions]:
    """Effects that are fitted along with the geometry, with their doubts as priors."""
    out = []
    for term, value in fitted_effects:
        main, doubt, owners = effect_motions(planner, term)
        size = np.maximum(np.abs(value[owners]), 1e-30)
        out += [main, replace(doubt, prior_precisions=1.0 / size**2)]
    return out


def separation_powers(
    planner: MeasurementPlanner, pair: ConfusedEffects
) -> dict[tuple[str, int], float]:
    """Power to tell the two apart: now (`old`), and with each proposal that concerns them."""
    mine, _, _ = effect_motions(planner, pair.effect)
    moved, foot = (
        np.tensordot(pair.effect_values, part, 1)[None]
        for part in (mine.target_motions, mine.foot_motions)
    )
    found = EffectMotions(moved, foot, np.zeros(1))
    rival = list(effect_motions(planner, pair.alternative)[:2])
    fitted = fitted_effect_motions(planner, pair.other_effects)
    count = sum(len(part.prior_precisions) for part in fitted)
    columns, poses = [*fitted, found, *rival], planner.measurement_plan.ranges_by_kind["foot"][1]
    everything = EffectMotions(
        np.concatenate([part.target_motions for part in columns]),
        np.concatenate(
            [
                part.foot_motions
                if part.foot_motions.shape[-1]
                else np.zeros((*part.foot_motions.shape[:-1], poses))
                for part in columns  # that do not move the foot leave it still
            ]
        ),
        np.concatenate([part.prior_precisions for part in columns]),
    )
    p = planner.geometry_columns.shape[1]
    rows = np.concatenate(
        [
            planner.geometry_columns,
            planner.row_rotations.rows_from_fields(everything.target_motions),
        ],
        axis=1,
    )
    rows *= planner.row_weight_roots[:, None]

    def products(key: tuple[str, int]) -> Array:
        kind, number = key
        if kind != "foot":
            part = rows[
                planner.pose_row_slice(planner.measurement_plan.select_plan_rows(kind, number))
            ]
            return np.asarray(part.T @ part)
        out = np.zeros((rows.shape[1],) * 2)
        feet = everything.foot_motions[..., :number]
        feet = feet - feet.mean(axis=-1, keepdims=True)  # where they sit is not known
        flat = feet.reshape(len(feet), -1)
        out[p:, p:] = flat @ flat.T / planner.noise.variance
        return out

    old = products(planner.proposed_measurements[0])
    old[np.arange(p, len(old)), np.arange(p, len(old))] += everything.prior_precisions
    concerned = {"old", "more", *list_relevant_kinds(planner, everything, count)}
    out = {}
    for key in planner.proposed_measurements:
        if key[0] in concerned:
            gram = old if key[0] == "old" else old + products(key)
            span = planner.identifiable_spans[key]
            half = np.concatenate([span.T @ gram[:p], gram[p:]])
            whole = np.concatenate([half[:, :p] @ span, half[:, p:]], axis=1)
            # What remains of the effect's motion once the rival has imitated it.
            left = schur_complement(whole, span.shape[1] + count, FITTED_COLUMN_RIDGE)
            scale = 1.0 / column_norms_from_gram(left[1:, 1:])
            unit = left[1:, 1:] * scale * scale[:, None]
            inverse = np.linalg.pinv(unit, 1e-9, hermitian=True)
            across = left[0, 1:] * scale
            out[key] = float(max(left[0, 0] - across @ inverse @ across, 0.0))
    return out


def list_relevant_kinds(
    planner: MeasurementPlanner, motions: EffectMotions, fitted_count: int
) -> list[str]:
    """Kinds of revisits at which the effect or its rival moves a point otherwise than before."""
    points = motions.target_motions[fitted_count:]
    found = ["foot"] if np.any(motions.foot_motions[fitted_count:]) else []
    first = np.argsort(planner.scene.column("clock"), kind="stable")[: max(REVISIT_POSE_COUNTS)]
    again = points[..., planner.measurement_plan.select_plan_rows("foot", max(REVISIT_POSE_COUNTS))]
    for kind, before in (("late", points[..., first]), ("load", again), ("side", again)):
        after = points[
            ..., planner.measurement_plan.select_plan_rows(kind, max(REVISIT_POSE_COUNTS))
        ]
        change, size = (np.abs(x).max(axis=(1, 2, 3)) for x in (after - before, before))
        if np.any(change > MIN_RELATIVE_FIELD_CHANGE * size):
            found.append(kind)
    return found


def rank_separating_measurements(
    planner: MeasurementPlanner, pair: ConfusedEffects
) -> tuple[MeasurementAdvice, ...]:
    """Further measurements that may tell an effect from a rival, the cheapest first."""
    found = separation_powers(planner, pair)
    advices = [
        MeasurementAdvice(
            describe_proposal(planner, kind, count),
            PREPARATION_MINUTES[kind] + MINUTES_PER_POSE * count,
            power,
        )
        for (kind, count), power in found.items()
        if kind != "old"
    ]
    return tuple(sorted(advices, key=lambda advice: advice.minutes))


def describe_best_separation(planner: MeasurementPlanner, pair: ConfusedEffects) -> str:
    """The cheapest measurement that has enough power; else the strongest, and what it lacks."""
    advices = rank_separating_measurements(planner, pair)
    for advice in advices:
        if advice.power >= SUFFICIENT_SEPARATION_POWER:
            return advice.text
    best = max(advices, key=lambda advice: advice.power)
    if pair.effect.effect == pair.alternative.effect and best.power < MAX_NEGLIGIBLE_POWER:
        return "no measurement can: one includes the other; more poses show what it has besides"
    raises = f"raises the power to {best.power:.2g} of the {SUFFICIENT_SEPARATION_POWER:.0f} needed"
    if best.power < MIN_HELPFUL_POWER_FRACTION * SUFFICIENT_SEPARATION_POWER:
        return f"no measurement considered is enough: the best {raises}"
    return f"{best.text}; that {raises}"


# ---- in words ----------------------------------------------------------------------------------


def describe_proposal(planner: MeasurementPlanner, kind: str, pose_count: int) -> str:
    """A proposal as one would say it to a technician."""
    scene = planner.scene
    if kind == "more":
        # Over the joints by which further poses reach farther than those at hand.
        lower, upper = joint_bounds(scene)
        narrow = np.ptp(scene.data.q, axis=0) < FULL_JOINT_RANGE_FRACTION * (upper - lower)
        names = [str(j + 1) for j in np.flatnonzero(narrow)]
        where = f"over the whole range of joint{'s' if len(names) > 1 else ''} "
        where += " and ".join([*filter(None, [", ".join(names[:-1])]), *names[-1:]])
        if not names:
            where = "all over the workspace"
        elif len(names) == scene.joints:
            where = "over the whole range of all joints"
        return f"measure {pose_count} more poses {where}"
    if kind == "load":
        extra = " more" if scene.column("payload").any() else ""
        return (
            f"measure the {pose_count} poses that reach out farthest again, with a payload of "
            f"{propose_payload(scene):g} kg{extra}"
        )
    return {
        "late": f"measure the first {pose_count} poses again at the end, with the arm warm",
        "side": f"measure {pose_count} of these poses again, each "
        f"approached from its other side by a "
        "short move of all joints",
        "foot": "put three reflectors on the robot's foot, far apart, and measure them at the "
        f"{pose_count} poses that reach out farthest",
    }[kind]

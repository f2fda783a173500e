"""What remains of an arm's errors: power against what no library holds, and no false alarm."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import shared
from numpy.testing import assert_allclose
from problems_fit import study

import minimax_cal as mc
from experiments import machines
from experiments.gap_cases import GapCase, GapCause, build_and_measure_arm
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing import noise_components
from minimax_cal.diagnosing.error_locations import (
    LocalDependence,
    locate_errors,
    summarise_region_errors,
    summarise_target_errors,
)
from minimax_cal.diagnosing.noise_components import (
    FullyMeasuredPoses,
    joint_and_sight_motions,
    reweight_by_noise_components,
    with_noise_weights,
)
from minimax_cal.diagnosing.remaining_error import (
    find_remaining_component,
    limit_joint_noise,
    most_telling_component,
)
from minimax_cal.diagnosing.study import (
    LEAST_SQUARES_OPTIONS,
    LinearisedGeometry,
    linearise_geometry,
)
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.remaining_components import (
    axis_tilt_motions,
    body_driver_features,
    fading_memory_features,
    joint_driver_features,
    slip_windup_features,
    smooth_curve_features,
)
from minimax_cal.modelling.simulate import Simulation, Truth, gravity, simulate
from minimax_cal.robots.kinematics import compute_link_frames, targets_in_base
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import Noise, estimate_noise_by_reml
from minimax_cal.selection.remaining_structure import RemainingComponent
from minimax_cal.selection.thresholds import (
    MIN_COMPONENT_SQUARE_FRACTION,
    MIN_SELECTION_DEGREES_OF_FREEDOM,
    REMAINING_STRUCTURE_P_VALUE,
    SOUND_JOINT_JITTER_RAD,
)


def of_arm(robot: Robot, data: Measurements) -> LinearisedGeometry:
    """The geometric fit of the training poses, linearised."""
    train, _, _ = split_train_and_holdout(add_history_columns(data), 0.2, 0)
    return linearise_geometry(
        robot, train, fit_cell(robot, train, Options(objective="sum"), silent_progress)
    )


def left(made: LinearisedGeometry, error: Array | None = None) -> tuple[RemainingComponent, ...]:
    """What remains beside geometry of rows (N,), or of the study's own."""
    rows = made.rows if error is None else replace(made.rows, error=error)
    return find_remaining_component(made.scene, rows, np.zeros((len(rows.error), 0)))


@pytest.mark.parametrize("law", ["outside_sum", "outside_product", "outside_waves"])
def test_laws_outside_the_library_remain_at_their_joint(law: str) -> None:
    sealed = build_and_measure_arm(
        GapCase("irb2600", "outside", (GapCause(law, "J2", 300.0),), seed=5)
    )
    found = most_telling_component(left(of_arm(sealed.robot, sealed.data)))
    assert found is not None
    assert found.place.startswith("J2")


@pytest.mark.parametrize(
    ("law", "place", "where"),
    [
        ("outside_plate", "all", ("plate following the tool's attitude",)),
        (
            "outside_clearance",
            "J2",
            ("J2 tilting following the loads", "J2 tilting following its own angle"),
        ),
        (
            "outside_settling_base",
            "frame",
            ("base following the loads of the past", "base following the previous poses"),
        ),
        ("outside_hysteresis", "J2", ("J2 following its past", "J2 following the previous poses")),
    ],
)
def test_mechanisms_and_memories_remain_where_they_are(
    law: str, place: str, where: tuple[str, ...]
) -> None:
    asked = machines.MachineCase("ur5e", "mechanism", (GapCause(law, place, 2000.0),), seed=3)
    sealed = machines.build_and_measure_arm(asked)
    found = left(of_arm(sealed.robot, sealed.data))
    first = most_telling_component(found)
    assert first is not None
    assert any(name.startswith(first.place) for name in where)
    assert any(
        one.place_and_driver in where and one.p < REMAINING_STRUCTURE_P_VALUE for one in found
    )  # which is first is chance


def test_a_joint_that_wanders_with_time_remains() -> None:
    """To and fro three times, of a joint among six: by a few hundredths of a milliradian."""
    made = study(3e-6, 1.0, 2)
    course = 5e-5 * np.cos(6.0 * np.pi * made.scene.column("clock"))
    found = most_telling_component(
        left(made, made.rows.error + clear(made, of_joint(made, 2, course)))
    )
    assert found is not None
    assert found.place == "J3"
    assert found.driver.startswith(("time", "the previous"))
    frozen = replace(made.scene.data, columns={"temperature": np.full(made.scene.poses, 20.0)})
    still = replace(made, scene=replace(made.scene, data=frozen))
    assert not [one for one in left(still) if "time" in one.driver or "previous" in one.driver]


def of_joint(made: LinearisedGeometry, joint: int, turn: Array) -> Array:
    """(N,) rows of a joint that turns by so much (m,) [rad]."""
    return made.rows.rows_from_fields((turn * made.scene.jacobian[joint])[None])[:, 0]


def clear(made: LinearisedGeometry, rows: Array) -> Array:
    """Rows (N,) without what geometry imitates."""
    return np.asarray(rows - made.rows.nuisance_basis @ (made.rows.nuisance_basis.T @ rows))


@pytest.mark.parametrize("kind", ["shakes", "J3"])
def test_scatter_from_visit_to_visit_does_not_remain(kind: str) -> None:
    """However it moves the targets: four drawings, of which one at most is called a remainder.

    And a law of the joint's angle beside its scatter still is, in all of them.
    """
    made, rng = study(6e-6, 1.0, 0), np.random.default_rng(7)
    law = of_joint(made, 4, 2e-4 * np.sin(made.scene.q[1] + made.scene.q[2]))
    loud = []
    for _ in range(4):
        own = 1.5e-5 * rng.normal(size=made.scene.points.shape)
        turn = 1e-4 * rng.normal(size=made.scene.poses)
        body = np.broadcast_to(2.5e-5 * rng.normal(size=(1, 3, made.scene.poses)), own.shape)
        moved = body if kind == "shakes" else made.scene.jacobian[int(kind[1:]) - 1] * turn
        error = made.rows.rows_from_fields((own + moved)[None])[:, 0]
        every = (left(made, clear(made, part)) for part in (error, error + law))
        loud.append([most_telling_component(one) is not None for one in every])
    alone, beside = np.array(loud).T
    assert np.count_nonzero(alone) <= 1
    assert np.all(beside)


def test_a_pose_that_is_off_does_not_remain() -> None:
    made, rng = study(6e-6, 1.0, 0, poses=50), np.random.default_rng(1)
    spread = np.sqrt(1e-10 * (1.0 + 0.5 * made.rows.variance_ratio))
    for pose in (0, 8, 24):
        error = spread * rng.normal(size=len(spread))
        error[np.flatnonzero(made.rows.row_groups == pose)[8]] += 9.0 * spread[0]
        assert most_telling_component(left(made, clear(made, error))) is None


def test_what_is_not_sure_or_does_not_matter_is_not_loud() -> None:
    one = RemainingComponent(
        "J1",
        "its load",
        9.0,
        0.1 * REMAINING_STRUCTURE_P_VALUE,
        2.0 * MIN_COMPONENT_SQUARE_FRACTION,
    )
    assert most_telling_component([one]) is one
    assert most_telling_component([replace(one, p=2.0 * REMAINING_STRUCTURE_P_VALUE)]) is None
    assert (
        most_telling_component([replace(one, square_fraction=0.5 * MIN_COMPONENT_SQUARE_FRACTION)])
        is None
    )
    assert (
        most_telling_component(
            [
                replace(one, square_fraction=0.5 * MIN_COMPONENT_SQUARE_FRACTION),
                replace(one, place="J2"),
            ]
        ).place
        == "J2"
    )  # type: ignore[union-attr]


def test_joints_are_taken_to_scatter_no_more_than_sound_ones_do() -> None:
    rows = study(6e-6, 1.0, 0).rows
    much = Noise(1e4, 1e-10, 1e-3)
    held = limit_joint_noise(much, rows)
    assert np.sqrt(
        held.joint_to_instrument_ratio * held.variance / rows.mean_variance_ratio
    ) == pytest.approx(SOUND_JOINT_JITTER_RAD)
    little = Noise(1e-3, 1e-12, 1e-7)
    assert limit_joint_noise(little, rows) == little


def test_an_axis_tilts_all_that_is_beyond_it() -> None:
    """As a chain does whose next link is turned about its own x: finite differences of alpha."""
    made = study(6e-6, 1.0, 0)
    scene, step = made.scene, 1e-6
    mdh = scene.robot.mdh.copy()
    mdh[1, 3] += step
    q = scene.q.T
    moved = targets_in_base(
        compute_link_frames(mdh, q, scene.robot.prismatic), scene.target_positions
    )
    before = targets_in_base(
        compute_link_frames(scene.robot.mdh, q, scene.robot.prismatic), scene.target_positions
    )
    slope = (moved - before) / step
    along_x, along_y = axis_tilt_motions(scene, 1)
    shift = scene.links.after[1] - scene.links.before[1]  # alpha turns about the link's far end
    far = np.cross(scene.links.x[1], shift, axis=0)
    np.testing.assert_allclose(slope, along_x - far, atol=1e-5)
    assert np.abs((along_x * along_y).sum(axis=-2)).max() > 0.0


def test_drivers_of_the_past_are_those_of_the_past() -> None:
    x = np.zeros(30)
    x[10] = 1.0
    past = fading_memory_features(x)
    assert np.all(past[:, :11] == 0.0)
    assert np.all(np.diff(past[:, 11:], axis=1) < 0.0)
    swing = slip_windup_features(np.tile([1.0, -1.0], 10))
    assert np.abs(swing).max() <= 2.0
    assert (
        smooth_curve_features(np.linspace(0.0, 3.0, 50), 0.15).shape[0]
        > smooth_curve_features(np.linspace(0, 3, 50), 1.0).shape[0]
    )


def test_a_load_that_is_rounding_drives_nothing(rng: np.random.Generator) -> None:
    """An upright joint carries none: what rounding leaves of it is no load of its own size."""
    scene = study(3e-6, 1.0, 2).scene
    rounded = replace(scene)
    vars(rounded)["gravity"] = scene.gravity + 1e-13 * rng.normal(size=scene.gravity.shape)
    assert not joint_driver_features(rounded, 0)["its load"].any()
    for name, feature in body_driver_features(scene).items():
        assert_allclose(
            body_driver_features(rounded)[name], feature, rtol=0, atol=1e-9, err_msg=name
        )


# ---- where ---------------------------------------------------------------------------------------


SIGMA = 15e-6
EXACT = Truth(compliance=0, noise=0, noise_per_metre=0)


def made(poses: int = 100, targets: int = 3, robot: str = "irb2600") -> Simulation:
    return simulate(mc.load_robot(robot), poses, targets, seed=1, truth=EXACT)


def fitted(sim: Simulation, turn=0.0, shift=0.0, **columns) -> LinearisedGeometry:
    """Of joints that turn by more, (m, n), and of targets that are shifted, (m, k, 3), in noise."""
    y = sim.cell.predict(sim.data.q + turn) + shift
    y = y + SIGMA * np.random.default_rng(0).normal(size=y.shape)
    data = replace(sim.data.with_y(y), columns={**sim.data.columns, **columns})
    data, robot = add_history_columns(data), sim.cell.robot
    return linearise_geometry(
        robot, data, fit_cell(robot, data, LEAST_SQUARES_OPTIONS, silent_progress)
    )


def test_noise_follows_nothing():
    """One chance for everything that is asked of an arm."""
    found = [locate_errors(study(6e-6, 1.0, seed)) for seed in range(8)]
    for places in zip(*(one.by_joint for one in found), strict=True):
        assert sum(one.what.p < 0.05 for one in places) <= 2
    assert sum(one.order.p < 0.05 for one in found) <= 2
    assert_allclose([one.noise for one in found], 17.5e-6, rtol=0.25)


def test_compliance_of_a_joint_appears_at_that_joint():
    """Torque at joint 2 alone, mostly a function of q2 and q3."""
    sim = made(120)
    bend = np.zeros_like(sim.data.q)
    bend[:, 1] = 1e-6 * gravity(sim.cell.robot, sim.data.q)[:, 1]
    found = locate_errors(fitted(sim, bend))
    share = [gap.what.share for gap in found.by_joint]
    assert np.argmax(share) == 1
    assert share[1] > 0.9
    assert found.by_joint[1].what.follows == "its load"
    assert found.by_joint[1].what.p < REMAINING_STRUCTURE_P_VALUE
    assert not found.order.p < REMAINING_STRUCTURE_P_VALUE


@pytest.mark.parametrize(("joint", "size"), [(0, 2e-4), (3, 2e-4), (5, 2e-4), (3, 1e-3), (5, 1e-3)])
def test_a_gear_error_appears_at_its_joint_with_its_size(joint, size):
    sim = made(120)
    turn = np.zeros_like(sim.data.q)
    turn[:, joint] = size * np.cos(2.0 * sim.data.q[:, joint] + 1.0)
    made_of = fitted(sim, turn)
    gap = locate_errors(made_of).by_joint[joint]
    assert (gap.what.place, gap.what.p < REMAINING_STRUCTURE_P_VALUE) == (f"J{joint + 1}", True)
    error = made_of.model.point_errors(made_of.fit.state)
    hidden = 1.0 - SIGMA**2 / (error**2).mean()
    assert_allclose(gap.what.share, hidden, atol=0.15)


def test_what_a_target_and_the_whole_arm_follow_in_time():
    sim = made(120)
    late, flange = np.arange(120) / 119.0, sim.cell.robot.pose(sim.data.q)[:, :3, :3]
    moved = np.zeros((120, 3, 3))
    slid = flange[:, :, 0] @ sim.cell.base[:3, :3].T
    moved[:, 1] = 150e-6 * np.cos(4.0 * late)[:, None] * slid
    found = locate_errors(fitted(sim, shift=moved))
    names = {one.name: one.what.p for one in found.by_target}
    assert names["smr2"] < REMAINING_STRUCTURE_P_VALUE
    assert found.order.p < REMAINING_STRUCTURE_P_VALUE
    assert max(found.by_target, key=lambda one: one.rms).name == "smr2"
    warm = 25.0 + 5.0 * np.random.default_rng(3).normal(size=120)
    lift = 10e-6 * (warm - 25.0)[:, None, None] * np.array([0.0, 0.6, 0.8])
    heated = locate_errors(fitted(sim, shift=lift, temperature=warm))
    assert heated.temperature.p < REMAINING_STRUCTURE_P_VALUE
    assert found.temperature is None


def test_one_target_has_a_mean_along_the_line_of_sight_and_a_region():
    sight = np.random.default_rng(0).normal(size=(50, 3))
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    error = 80e-6 * sight
    error[::5] = np.nan
    gap = summarise_target_errors("smr1", error, sight, LocalDependence())
    assert gap.points == 40
    assert_allclose([gap.sight, gap.rms, gap.worst], 80e-6, rtol=1e-12)
    none = summarise_target_errors("smr2", np.full((50, 3), np.nan), sight, LocalDependence())
    assert none.points == 0
    assert math.isnan(none.rms)


def test_the_worst_region_is_where_the_error_is():
    point = np.random.default_rng(0).normal(size=(100, 3, 3))
    far = np.hypot(point[..., 0], point[..., 1])
    size = np.where(far > np.quantile(far, 2 / 3), 5e-5, 1e-5)
    cells = summarise_region_errors(
        size[..., None] * np.array([1.0, 0.0, 0.0]), point, np.array([0.0, 0.0, 1.0])
    )
    worst = [one for one in cells if one.rms > 4.9e-5]
    farthest = max(one.radius[1] for one in cells)
    assert len(worst) == 3
    assert {one.radius[1] for one in worst} == {farthest}


def test_a_slide_is_in_millimetres_and_nothing_is_nan():
    sim = made(80, 3, "scara_600")
    slide = int(np.argmax(sim.cell.robot.prismatic))
    turn = np.zeros_like(sim.data.q)
    turn[:, slide] = 1e-4 * np.cos(40.0 * sim.data.q[:, slide])
    said = locate_errors(fitted(sim, turn)).to_dict()
    assert "rms_mm" in said["by_joint"][slide]
    assert "rms_mrad" in said["by_joint"][0]
    json.dumps(said, allow_nan=False)


def test_rounding_follows_nothing():
    sim = made(60)
    robot, data = sim.cell.robot, add_history_columns(sim.data)
    found = locate_errors(
        linearise_geometry(
            robot, data, fit_cell(robot, data, LEAST_SQUARES_OPTIONS, silent_progress)
        )
    )
    assert all(math.isnan(one.what.p) for one in found.by_joint)
    json.dumps(found.to_dict(), allow_nan=False)


def test_a_real_arm():
    """IRB 120, commanded joints: gravity bends joint 2 and 3, not the frame."""
    name, path = shared("irb120")
    robot, data = mc.load_robot(name), add_history_columns(mc.read_measurements(path))
    found = locate_errors(
        linearise_geometry(
            robot, data, fit_cell(robot, data, LEAST_SQUARES_OPTIONS, silent_progress)
        )
    ).to_dict()
    share = {gap["joint"]: gap["share"] for gap in found["by_joint"]}
    assert max(share, key=lambda joint: share[joint]) in ("J1", "J2", "J3")
    assert found["noise_mm"] < 30e-3
    json.dumps(found, allow_nan=False)


# ---- scatter -------------------------------------------------------------------------------------


QUIET, LOUD = 1e-5, 1e-4  # joints [rad]
POINT = 2e-5  # of a coordinate [m]


@pytest.fixture(scope="module")
def plain() -> LinearisedGeometry:
    return study(0.0, 0.01, 0, poses=100)


def drawn(
    made: LinearisedGeometry, joints: Array, along: float, across: float, seed: int
) -> LinearisedGeometry:
    """The study with errors of given noises: joints (n,) [rad], of a coordinate [m]."""
    rng = np.random.default_rng(seed)
    moved, sight = joint_and_sight_motions(made)
    sizes = (*joints, along, across)
    fields = [(part, size) for part, size in zip((*moved, *sight), sizes, strict=True)]
    y = sum(size * np.einsum("dkcm,dm->kcm", part, rng.normal(size=(len(part), made.scene.poses)))
            for part, size in fields)  # fmt: skip
    moved = np.moveaxis(np.asarray(y), -1, 0) @ made.fit.state.rotation.T
    data = made.data.with_y(made.data.y + moved)
    return linearise_geometry(
        made.robot, data, fit_cell(made.robot, data, LEAST_SQUARES_OPTIONS, silent_progress)
    )


def nothing(made: LinearisedGeometry) -> Array:
    return np.zeros((len(made.rows.error), 0))


def test_noises_that_are_alike_stay_so(plain: LinearisedGeometry) -> None:
    for seed in range(4):
        made = drawn(plain, np.full(6, QUIET), POINT, POINT, seed)
        assert reweight_by_noise_components(made, nothing(made)) is made


def test_a_wrist_that_scatters_hides_the_shoulder_no_more(plain: LinearisedGeometry) -> None:
    """A turn of joint 1 is seen by so much more as its own scatter is smaller than the mean."""
    joints = np.full(6, QUIET)
    joints[4:] = 3.0 * LOUD
    made = drawn(plain, joints, POINT, POINT, 1)
    found = reweight_by_noise_components(made, nothing(made))
    seen = []
    for one in (made, found):
        arm = one.rows.rows_from_fields(plain.scene.jacobian[:1])[:, 0]
        seen.append(
            float(estimate_noise_by_reml(one.rows, nothing(one)).row_weights(one.rows) @ arm**2)
        )
    assert seen[1] > 3.0 * seen[0]
    assert seen[1] < 1.5 * plain.scene.poses / QUIET**2  # by its scatter alone, which is estimated


def test_an_instrument_whose_directions_differ(plain: LinearisedGeometry) -> None:
    still = 0.2 * QUIET
    made = drawn(plain, np.full(6, still), 0.4 * POINT, 1.5 * POINT, 2)
    found = reweight_by_noise_components(made, nothing(made))
    _, sight = joint_and_sight_motions(made)
    variance = 1.0 / estimate_noise_by_reml(found.rows, nothing(found)).row_weights(found.rows)
    m, r = found.rows.weight.shape
    arm = found.rows.rows_from_fields(plain.scene.jacobian).reshape(m, r, -1)
    for part, size in zip(sight, (0.4 * POINT, 1.5 * POINT), strict=True):
        rows = found.rows.rows_from_fields(part).reshape(m, r, -1)
        told = np.einsum("mrd,mr->md", rows**2, variance.reshape(m, r)).mean()
        of_joints = still**2 * (np.einsum("mrd,mrj->mdj", rows, arm) ** 2).sum(axis=2).mean()
        assert abs(told - of_joints - size**2) < 0.2 * POINT**2
    mean = (0.4**2 + 2.0 * 1.5**2) / 3.0 * POINT**2
    assert (
        abs(
            found.variance_anisotropy
            * estimate_noise_by_reml(found.rows, nothing(found)).variance
            / mean
            - 1.0
        )
        < 0.2
    )


def test_the_slope_is_that_of_the_likelihood(plain: LinearisedGeometry) -> None:
    made = drawn(plain, np.full(6, QUIET), POINT, POINT, 3)
    joints, sight = joint_and_sight_motions(made)
    rest = FullyMeasuredPoses.from_study(made, nothing(made), np.ones(made.scene.poses, dtype=bool))
    parts = np.concatenate([rest.field_covariances(joints), rest.field_covariances(sight)])
    at = np.log(np.array([*np.linspace(0.5, 2.0, 6) * QUIET, POINT, 2.0 * POINT]) ** 2)
    _, slope = rest.restricted_deviance_and_gradient(at, parts)
    step = 1e-4 * np.eye(len(at))
    steps = [
        rest.restricted_deviance_and_gradient(at + d, parts)[0]
        - rest.restricted_deviance_and_gradient(at - d, parts)[0]
        for d in step
    ]
    assert_allclose(slope, np.array(steps) / 2e-4, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(("along", "across"), [(0.4, 1.5), (1.5, 0.4), (0.01, 1.0)])
def test_weighed_rows_have_the_covariance_of_the_noises(
    plain: LinearisedGeometry, along: float, across: float
) -> None:
    """With the variance of the best direction, and the joints' RMS as their scatter."""
    joints = QUIET * np.arange(1.0, 7.0)
    variance = (POINT * np.array([along, across])) ** 2
    turned, sight = joint_and_sight_motions(plain)
    found = with_noise_weights(plain, joints, sight, variance)
    assert_allclose(
        found.variance_anisotropy,
        (variance[0] + 2.0 * variance[1]) / 3.0 / variance.min()
        if variance.min() > 1e-3 * variance.max()
        else 20.0,
        rtol=1e-12,
    )
    mean = (variance[0] + 2.0 * variance[1]) / 3.0
    best = mean / found.variance_anisotropy
    alike = best + np.mean(joints**2) * found.rows.mean_variance_ratio * found.rows.variance_ratio
    m, r = found.rows.weight.shape
    told = (found.rows.turn * alike.reshape(m, 1, r)) @ np.swapaxes(found.rows.turn, 1, 2)

    def spread(field: Array) -> Array:
        flat = np.moveaxis(field.reshape(len(field), r, m), -1, 0)
        return np.asarray(np.swapaxes(flat, 1, 2) @ flat)

    size = np.maximum(variance, best)
    expected = sum(joint**2 * spread(part) for joint, part in zip(joints, turned, strict=True))
    expected = expected + sum(s * spread(part) for s, part in zip(size, sight, strict=True))
    assert_allclose(told, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_motions_are_those_of_a_point_of_unit_weight(plain: LinearisedGeometry) -> None:
    heavy = replace(plain, model=replace(plain.model, weight=4.0 * plain.model.weight))
    joints, sight = joint_and_sight_motions(plain)
    for one, other in zip(sight, joint_and_sight_motions(heavy)[1], strict=True):
        assert_allclose(other, 0.5 * one, rtol=1e-12)
    assert_allclose(joint_and_sight_motions(heavy)[0], joints, rtol=0, atol=0)
    flat = np.concatenate(sight)
    assert_allclose(np.einsum("dkcm,dlem->mkcle", flat, flat),
                    np.broadcast_to(np.eye(9).reshape(3, 3, 3, 3), (plain.scene.poses, 3, 3, 3, 3)),
                    atol=1e-12)  # fmt: skip


def test_poses_that_lack_a_point_do_not_count(plain: LinearisedGeometry) -> None:
    """Joints scatter unlike each other at the other poses, and that is found."""
    joints = np.array([1.0, 1.0, 1.0, 1.0, 30.0, 30.0]) * QUIET
    made = drawn(plain, joints, POINT, POINT, 1)
    y = made.data.y.copy()
    y[::9, 0] = np.nan
    part = made.data.with_y(y)
    some = linearise_geometry(
        made.robot, part, fit_cell(made.robot, part, LEAST_SQUARES_OPTIONS, silent_progress)
    )
    found = reweight_by_noise_components(some, nothing(some))
    assert found is not some
    assert (
        0.8
        < estimate_noise_by_reml(found.rows, nothing(found)).joint_jitter
        / np.sqrt(np.mean(joints**2))
        < 1.25
    )


def test_of_few_poses_or_of_computed_points_nothing_is_said(
    plain: LinearisedGeometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        noise_components, "CERTAIN_P_VALUE", 1.0
    )  # noises alike are weighed anew too
    made = drawn(plain, np.full(6, QUIET), POINT, POINT, 1)
    rows = 3 * made.scene.targets
    few = -(
        -(made.rows.nuisance_basis.shape[1] + int(MIN_SELECTION_DEGREES_OF_FREEDOM)) // rows
    )  # poses that are just enough
    for count in (few - 1, few):
        data = made.data.take(np.arange(made.scene.poses) < count)
        some = linearise_geometry(made.robot, data, made.fit)
        assert (reweight_by_noise_components(some, nothing(some)) is some) == (count < few)
    spare = rows * few - made.rows.nuisance_basis.shape[1] - int(MIN_SELECTION_DEGREES_OF_FREEDOM)
    columns = np.eye(rows * few)[:, : spare + 1]  # each known column costs a degree of freedom
    assert reweight_by_noise_components(some, columns[:, :spare]) is not some
    assert reweight_by_noise_components(some, columns) is some
    usual = np.sqrt(estimate_noise_by_reml(made.rows, nothing(made)).variance)
    for size, told in ((1e-2, False), (1e2, True)):
        error = size * made.rows.rounding_noise / usual * made.rows.error
        exact = replace(made, rows=replace(made.rows, error=error))
        assert (reweight_by_noise_components(exact, nothing(exact)) is exact) != told

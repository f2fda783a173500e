"""What remains of an arm's errors: power against what no library holds, and no false alarm."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study

from experiments import machines
from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.diagnosing.what_remains import anchored, left_over, loudest
from minimax_cal.evidence.limits import MAX_JOINT_JITTER, STRUCTURE, WORTH
from minimax_cal.evidence.noise import Noise
from minimax_cal.evidence.remains import Remains
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.remaining import curve, faded, own, tilts, together, wound
from minimax_cal.robots.kinematics import chain, points
from minimax_cal.robots.robot import Robot


def of_arm(robot: Robot, data: Measurements) -> Study:
    """The geometric fit of the training poses, linearised."""
    train, _, _ = split(with_history(data), 0.2, 0)
    return studied(robot, train, fit_cell(robot, train, Options(objective="sum"), silent))


def left(made: Study, error: Array | None = None) -> tuple[Remains, ...]:
    """What remains beside geometry of rows (N,), or of the study's own."""
    rows = made.rows if error is None else replace(made.rows, error=error)
    return left_over(made.scene, rows, np.zeros((len(rows.error), 0)))


@pytest.mark.parametrize("law", ["outside_sum", "outside_product", "outside_waves"])
def test_laws_outside_the_library_remain_at_their_joint(law: str) -> None:
    sealed = make(Case("irb2600", "outside", (Cause(law, "J2", 300.0),), seed=5))
    found = loudest(left(of_arm(sealed.robot, sealed.data)))
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
    asked = machines.Asked("ur5e", "mechanism", (Cause(law, place, 2000.0),), seed=3)
    sealed = machines.make(asked)
    found = left(of_arm(sealed.robot, sealed.data))
    first = loudest(found)
    assert first is not None
    assert any(name.startswith(first.place) for name in where)
    assert any(one.name in where and one.p < STRUCTURE for one in found)  # which is first is chance


def test_a_joint_that_wanders_with_time_remains() -> None:
    """To and fro three times, of a joint among six: by a few hundredths of a milliradian."""
    made = study(3e-6, 1.0, 2)
    course = 5e-5 * np.cos(6.0 * np.pi * made.scene.column("clock"))
    found = loudest(left(made, made.rows.error + clear(made, of_joint(made, 2, course))))
    assert found is not None
    assert found.name in ("J3 following time, to and fro", "J3 following the previous poses")
    frozen = replace(made.scene.data, columns={"temperature": np.full(made.scene.poses, 20.0)})
    still = replace(made, scene=replace(made.scene, data=frozen))
    assert not [one for one in left(still) if "time" in one.driver or "previous" in one.driver]


def of_joint(made: Study, joint: int, turn: Array) -> Array:
    """(N,) rows of a joint that turns by so much (m,) [rad]."""
    return made.rows.of((turn * made.scene.jacobian[joint])[None])[:, 0]


def clear(made: Study, rows: Array) -> Array:
    """Rows (N,) without what geometry imitates."""
    return np.asarray(rows - made.rows.basis @ (made.rows.basis.T @ rows))


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
        error = made.rows.of((own + moved)[None])[:, 0]
        every = (left(made, clear(made, part)) for part in (error, error + law))
        loud.append([loudest(one) is not None for one in every])
    alone, beside = np.array(loud).T
    assert np.count_nonzero(alone) <= 1
    assert np.all(beside)


def test_a_pose_that_is_off_does_not_remain() -> None:
    made, rng = study(6e-6, 1.0, 0, poses=50), np.random.default_rng(1)
    spread = np.sqrt(1e-10 * (1.0 + 0.5 * made.rows.variance_ratio))
    for pose in (0, 8, 24):
        error = spread * rng.normal(size=len(spread))
        error[np.flatnonzero(made.rows.group == pose)[8]] += 9.0 * spread[0]
        assert loudest(left(made, clear(made, error))) is None


def test_what_is_not_sure_or_does_not_matter_is_not_loud() -> None:
    one = Remains("J1", "its load", 9.0, 0.1 * STRUCTURE, 2.0 * WORTH)
    assert loudest([one]) is one
    assert loudest([replace(one, p=2.0 * STRUCTURE)]) is None
    assert loudest([replace(one, share=0.5 * WORTH)]) is None
    assert loudest([replace(one, share=0.5 * WORTH), replace(one, place="J2")]).place == "J2"  # type: ignore[union-attr]


def test_joints_are_taken_to_scatter_no_more_than_sound_ones_do() -> None:
    rows = study(6e-6, 1.0, 0).rows
    much = Noise(1e4, 1e-10, 1e-3)
    held = anchored(much, rows)
    assert np.sqrt(held.ratio * held.variance / rows.size) == pytest.approx(MAX_JOINT_JITTER)
    little = Noise(1e-3, 1e-12, 1e-7)
    assert anchored(little, rows) == little


def test_an_axis_tilts_all_that_is_beyond_it() -> None:
    """As a chain does whose next link is turned about its own x: finite differences of alpha."""
    made = study(6e-6, 1.0, 0)
    scene, step = made.scene, 1e-6
    mdh = scene.robot.mdh.copy()
    mdh[1, 3] += step
    q = scene.q.T
    moved = points(chain(mdh, q, scene.robot.prismatic), scene.target_positions)
    before = points(chain(scene.robot.mdh, q, scene.robot.prismatic), scene.target_positions)
    slope = (moved - before) / step
    along_x, along_y = tilts(scene, 1)
    shift = scene.links.after[1] - scene.links.before[1]  # alpha turns about the link's far end
    far = np.cross(scene.links.x[1], shift, axis=0)
    np.testing.assert_allclose(slope, along_x - far, atol=1e-5)
    assert np.abs((along_x * along_y).sum(axis=-2)).max() > 0.0


def test_drivers_of_the_past_are_those_of_the_past() -> None:
    x = np.zeros(30)
    x[10] = 1.0
    past = faded(x)
    assert np.all(past[:, :11] == 0.0)
    assert np.all(np.diff(past[:, 11:], axis=1) < 0.0)
    swing = wound(np.tile([1.0, -1.0], 10))
    assert np.abs(swing).max() <= 2.0
    assert (
        curve(np.linspace(0.0, 3.0, 50), 0.15).shape[0] > curve(np.linspace(0, 3, 50), 1.0).shape[0]
    )


def test_a_load_that_is_rounding_drives_nothing(rng: np.random.Generator) -> None:
    """An upright joint carries none: what rounding leaves of it is no load of its own size."""
    scene = study(3e-6, 1.0, 2).scene
    rounded = replace(scene)
    vars(rounded)["gravity"] = scene.gravity + 1e-13 * rng.normal(size=scene.gravity.shape)
    assert not own(rounded, 0)["its load"].any()
    for name, feature in together(scene).items():
        assert_allclose(together(rounded)[name], feature, rtol=0, atol=1e-9, err_msg=name)

"""Every effect's law against an independent expectation, and its columns against finite changes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from numpy.testing import assert_allclose
from problems_fit import MASSES, SPOTS, weighty
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects import EFFECTS, PosedArm, Term
from minimax_cal.modelling.effects.compliance import soft_start_torque_and_slope
from minimax_cal.modelling.effects.scene import EffectColumns
from minimax_cal.modelling.effects.table import Fitted, fitted_effects_from_list, parse_effect_terms
from minimax_cal.modelling.effects.time_effects import REFERENCE_TEMPERATURE_C
from minimax_cal.modelling.simulate import gravity
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity_torques import ASSUMED_LINK_MASS_PER_METRE, STANDARD_GRAVITY
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import robot_from_dict

DOCS = ROOT / "docs" / "effects.md"
EXACT = 1e-12  # relative: the same arithmetic by another way
BASE = (Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix(), np.array([2.5, -1.0, 0.4]))
# with gear ratios, one reversed joint and a base that is not level
ROBOT = weighty(2, [0.1, -0.05, 1.0], ratio=101.0)


def visited(robot: mc.Robot, poses: int = 40, seed: int = 0) -> mc.Measurements:
    """Poses in an order, with the columns that laws ask for."""
    rng = np.random.default_rng(seed)
    q = random_joint_values_above_floor(robot, poses, rng)
    return mc.measurements(
        q,
        np.ones((poses, 3, 3)) * np.arange(1.0, 1.0 + poses)[:, None, None],
        order=np.arange(poses, dtype=float),
        time=np.sort(rng.uniform(0.0, 3600.0, poses)),
        temperature=rng.uniform(18.0, 30.0, poses),
        payload=rng.choice([0.0, 5.0, 10.0], poses),
    )


def scene_of(robot: mc.Robot, data: mc.Measurements) -> PosedArm:
    return PosedArm.at_measured_poses(robot, data, BASE, SPOTS, robot.chain_joint_values(data.q))


def all_terms(scene: PosedArm) -> list[Term]:
    """Every effect at every place, in every variant and some finer ones."""
    out = []
    for name, effect in EFFECTS.items():
        for place in effect.places(scene):
            for choice in effect.choices(scene, place):
                out += [Term(name, place, c) for c in (choice, *effect.finer(scene, choice)[:2])]
    return [*out, Term("session_jump", "frame", {"since": 0.4})]  # a moment that errors show


DATA = visited(ROBOT)
SCENE = scene_of(ROBOT, DATA)
NO_MASSES = replace(ROBOT, mass=np.full(6, np.nan), com=np.full((6, 3), np.nan))
SLIDING = replace(ROBOT, prismatic=np.arange(6) == 2)
TAU = {f"tau{j + 1}": np.random.default_rng(j).normal(size=40) for j in range(6)}
LINKED = np.eye(6) - np.eye(6, k=-1) * [0, 1, 0, 0.5, 0, 0]  # J3 by q3 - q2, J5 by q5 - q4 / 2
COUPLED = replace(ROBOT, coupling=LINKED)
SCENES = {
    "masses": SCENE,
    "coupled": scene_of(COUPLED, DATA),
    "no masses": scene_of(NO_MASSES, DATA),
    "a slide": scene_of(SLIDING, visited(SLIDING)),
    "torques": scene_of(ROBOT, replace(DATA, columns={**DATA.columns, **TAU})),
}


def columns(name: str, place: str, scene: PosedArm = SCENE, **choice: float) -> EffectColumns:
    return Term(name, place, choice).columns(scene)


def test_the_scene_shows_every_effect():
    assert {term.effect for term in all_terms(SCENE)} == set(EFFECTS)
    assert all(effect.needs(SCENE) == "" for effect in EFFECTS.values())


def test_every_effect_is_in_the_guide():
    text = DOCS.read_text()
    for effect in EFFECTS.values():
        assert f"`{effect.name}`" in text


@pytest.mark.parametrize("which", SCENES)
def test_columns_have_names_units_and_finite_fields(which):
    scene = SCENES[which]
    for term in all_terms(scene):
        found = term.columns(scene)
        field = found.target_displacements(scene)
        assert len(found.names) == len(found.units) == len(field), term
        assert field.shape[1:] == scene.points.shape, term
        assert np.all(np.isfinite(field)), term
        assert np.all(np.abs(field).max(axis=(1, 2, 3)) > 0.0), term
        assert len(set(found.names)) == len(found.names), term
        for owner, doubt in found.displacement_uncertainties(scene):
            assert 0 <= owner < len(found.names), term
            assert doubt.shape[1:] == scene.points.shape, term
            assert np.all(np.isfinite(doubt)), term


@pytest.mark.parametrize("which", SCENES)
def test_the_text_of_a_variant_means_that_variant(which):
    """And leaves nothing to be picked, unless the law's plain form has nothing to write."""
    scene = SCENES[which]

    def never(chosen: Sequence[Term], several: Sequence[Term]) -> Term:
        raise AssertionError([term.text for term in several])

    for term in all_terms(scene):
        if term.choice:
            (found,) = parse_effect_terms(scene, [term.text], never)
            assert found.text == term.text or dict(found.choice) == dict(term.choice), term


def test_what_one_variant_has_does_not_go_with_another():
    scene = SCENES["no masses"]
    plain, *_, last = EFFECTS["joint_compliance"].choices(scene, "J2")
    assert "assumed" in last
    with pytest.raises(mc.OptionError, match="no variant has"):
        parse_effect_terms(scene, [f"joint_compliance:J2:parts={plain['parts']}:within=3"])


@pytest.mark.parametrize("which", SCENES)
def test_columns_are_the_derivative_of_the_points(which):
    """Central difference of the exact points; its own error is of second order in the step."""
    scene = SCENES[which]
    for term in all_terms(scene):
        field = term.columns(scene).target_displacements(scene)
        for i, jacobian in enumerate(field):
            step = 1e-5 / np.abs(jacobian).max() * np.eye(len(field))[i]  # moves by 10 um at most
            up, down = (
                Fitted((term,), (sign * step,)).displaced_targets(scene) for sign in (1.0, -1.0)
            )
            change = (up - down) / (2.0 * step[i])
            assert_allclose(
                change, jacobian, rtol=0, atol=1e-5 * np.abs(jacobian).max(), err_msg=term
            )


@pytest.mark.parametrize("which", SCENES)
def test_a_part_of_the_data_sees_the_same_law(which):
    """With the history kept, a pose's displacement does not depend on which others are there."""
    scene = SCENES[which]
    for rows in (np.arange(5, 25), np.array([7])):
        part = scene_of(scene.robot, scene.data.take(rows))
        for term in all_terms(scene):
            whole, some = term.columns(scene), term.columns(part)
            assert some.names == whole.names, term
            assert some.units == whole.units, term
            expected = whole.target_displacements(scene)[..., rows]
            size = np.abs(expected).max()
            found = some.target_displacements(part)
            assert_allclose(found, expected, rtol=0, atol=1e-9 * size, err_msg=term)


def test_effects_are_read_back_from_their_json():
    terms = tuple(all_terms(SCENE))
    values = tuple(1e-6 * np.ones(len(term.columns(SCENE).names)) for term in terms)
    told = Fitted(terms, values)
    again = fitted_effects_from_list(told.to_list())
    assert_allclose(again.displaced_targets(SCENE), told.displaced_targets(SCENE), rtol=0, atol=0)


# ---------------------------------------------------------------- weight


def potential(scene: PosedArm, q: Array) -> Array:
    """(m,) potential energy of links and payload at joint values (m, n), frame by frame [J]."""
    robot, payload = scene.robot, scene.column("payload")
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    energy = np.zeros(len(q), dtype=q.dtype)
    for i, (a, d, theta, alpha, beta) in enumerate(robot.mdh):
        turn = q[:, i] + theta
        link = np.zeros((len(q), 4, 4), dtype=q.dtype)
        ca, sa = np.cos(alpha), np.sin(alpha)
        c, s = np.cos(turn), np.sin(turn)
        link[:, 0], link[:, 1] = (np.stack(row, axis=-1) for row in (
            (c, -s * ca, s * sa, a * c), (s, c * ca, -c * sa, a * s)))  # fmt: skip
        link[:, 2], link[:, 3] = (0.0, sa, ca, d), (0.0, 0.0, 0.0, 1.0)
        assert beta == 0.0
        pose = pose @ link
        centre = pose[:, :3, :3] @ scene.link_masses_and_centres[1][i] + pose[:, :3, 3]
        energy = energy + scene.link_masses_and_centres[0][i] * STANDARD_GRAVITY * (
            centre @ robot.up
        )
    tip = pose[:, :3, :3] @ scene.target_positions.mean(axis=0) + pose[:, :3, 3]
    return np.asarray(energy + payload * STANDARD_GRAVITY * (tip @ robot.up))


@pytest.mark.parametrize("which", ["masses", "no masses", "coupled"])
def test_torque_is_minus_the_slope_of_the_potential_energy(which):
    """Of a drive that moves several joints, by its own value."""
    scene = SCENES[which]
    for j in range(6):
        moved = scene.robot.chain_joint_values(DATA.q + 1e-30j * scene.robot.sign[j] * np.eye(6)[j])
        jacobian = potential(scene, moved).imag / 1e-30
        assert_allclose(scene.gravity[j], -jacobian, rtol=0, atol=EXACT * 1e4)


@pytest.mark.dev
def test_torque_is_the_one_of_pinocchio():
    pin = pytest.importorskip("pinocchio")
    data = replace(DATA, columns={k: v for k, v in DATA.columns.items() if k != "payload"})
    scene = scene_of(ROBOT, data)
    model = pin.Model()
    model.gravity.linear = -STANDARD_GRAVITY * ROBOT.up
    before = pin.SE3.Identity()  # what lies between the frame before and the joint's axis
    parent = 0
    for i, (a, d, theta, alpha, beta) in enumerate(ROBOT.mdh):
        parent = model.addJoint(parent, pin.JointModelRZ(), before, f"j{i}")
        turn = Rotation.from_euler("XY", [alpha, beta]).as_matrix()
        before = pin.SE3(turn, np.array([a, 0.0, d]))
        turned = Rotation.from_euler("z", theta).as_matrix()
        before = pin.SE3(turned, np.zeros(3)) * before  # theta after the joint: a fixed turn
        inertia = pin.Inertia(MASSES[i], before.act(ROBOT.com[i]), np.zeros((3, 3)))
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
    memory = model.createData()
    for m in range(scene.poses):
        expected = -pin.computeGeneralizedGravity(model, memory, scene.q[:, m])
        assert_allclose(scene.gravity[:, m], expected, rtol=0, atol=EXACT * 1e4)


def test_compliant_joints_turn_with_their_torque():
    for j in range(1, 6):
        choice, *_ = EFFECTS["joint_compliance"].choices(SCENE, f"J{j + 1}")
        found = columns("joint_compliance", f"J{j + 1}", **choice)
        assert found.names == (f"c{j + 1}",)
        assert_allclose(found.turn[0, j], SCENE.gravity[j], rtol=EXACT)
        assert not np.delete(found.turn[0], j, axis=0).any()


def test_gears_act_at_drives_and_bearings_at_joints():
    """A gear's error moves the arm as an error of its drive's value; bearings as if uncoupled."""
    scene = SCENES["coupled"]
    alike = scene_of(ROBOT, replace(DATA, q=COUPLED.chain_joint_values(DATA.q) * ROBOT.sign))
    for term in all_terms(scene):
        found = term.columns(scene)
        if term.effect in ("axis_wobble", "link_bending"):
            ours, theirs = (
                term.columns(each).target_displacements(each) for each in (scene, alike)
            )
            assert_allclose(ours, theirs, rtol=0, atol=EXACT * np.abs(theirs).max())
        elif found.moves_joints_only and term.effect != "joint_coupling" and term.place[0] == "J":
            j = int(term.place[1:]) - 1
            by = 1e-7 * found.turn[:, j] * ROBOT.sign[j]
            moved = [COUPLED.pose(DATA.q + one[:, None] * np.eye(6)[j]) for one in by]
            there = [pose[:, :3, :3] @ SPOTS.T + pose[:, :3, 3:] for pose in moved]
            fields = np.moveaxis(there, (1, 2, 3), (3, 2, 1)) - scene.points
            second = max(1e-10, 20.0 * (by**2).max())
            wanted = 1e-7 * found.target_displacements(scene)
            assert_allclose(fields, wanted, rtol=0, atol=second, err_msg=term.text)
    error = Term("joint_coupling", "J3", {"source": 2.0})  # an entry of the matrix that is wrong
    turn = Fitted((error,), (np.array([1e-3]),)).joint_shifts(scene)
    off = replace(COUPLED, coupling=LINKED + 1e-3 * np.eye(6)[:, 2:3] * np.eye(6)[1])
    wanted = off.chain_joint_values(DATA.q) - COUPLED.chain_joint_values(DATA.q)
    assert_allclose(turn * ROBOT.sign[2], wanted, rtol=0, atol=EXACT)


def test_a_joint_that_stiffens_gives_way_to_the_first_of_its_torque():
    """As its compliance tells where the torque is small; never by more than at the torque told."""
    effect, tau = EFFECTS["joint_compliance"], SCENE.gravity[1]
    _, *stiffening = effect.choices(SCENE, "J2")
    assert [choice["within"] / np.abs(tau).max() for choice in stiffening] == [0.15, 0.5]
    for choice in stiffening:
        within = choice["within"]
        found = columns("joint_compliance", "J2", **choice)
        assert (found.names, dict(found.fixed)) == (("c2",), {"within_Nm": within})
        assert_allclose(found.turn[0, 1], within * np.tanh(tau / within), rtol=EXACT)
        assert effect.nonnegative_mask(found).all()
        ends = [c["within"] / np.abs(tau).max() for c in effect.finer(SCENE, choice)]
        assert min(ends) >= 0.03
        assert max(ends) <= 1.5
    assert not any("within" in choice for choice in effect.choices(SCENE, "all"))
    (plain,) = effect.choices(SCENE, "all")
    assert effect.finer(SCENE, plain) == ()


def test_the_doubts_of_a_joint_that_stiffens_are_those_of_its_torque_there():
    """Against a central difference, whose error is of second order in the step."""
    torque, other = np.linspace(-40.0, 60.0, 25), np.linspace(5.0, -3.0, 25)
    up, down = (
        soft_start_torque_and_slope(torque + sign * 1e-4 * other, 12.0)[0] for sign in (1.0, -1.0)
    )
    assert_allclose(
        soft_start_torque_and_slope(torque, 12.0)[1] * other, (up - down) / 2e-4, rtol=0, atol=1e-8
    )


def test_payload_adds_its_torque_even_where_it_never_changes():
    loaded = replace(DATA, columns={**DATA.columns, "payload": np.full(40, 7.0)})
    empty = replace(DATA, columns={**DATA.columns, "payload": np.zeros(40)})
    with_load, without = scene_of(ROBOT, loaded), scene_of(ROBOT, empty)
    centre = SCENE.points.mean(axis=0)
    pull = np.broadcast_to(-7.0 * STANDARD_GRAVITY * ROBOT.up[:, None], centre.shape)
    for j in range(6):
        arm = centre - SCENE.links.before[j]
        torque = (SCENE.links.z[j] * np.cross(arm, pull, axis=0)).sum(axis=0)
        found = with_load.gravity[j] - without.gravity[j]
        assert_allclose(found, torque, rtol=0, atol=EXACT * 1e4)


def test_measured_torques_replace_computed_ones():
    scene = SCENES["torques"]
    for j in range(6):
        expected = TAU[f"tau{j + 1}"] * ROBOT.sign[j]
        assert_allclose(scene.gravity[j], expected, rtol=0, atol=0)
    assert not len(scene.gravity_changes_per_sigma)  # what is measured is not doubted


@pytest.mark.parametrize("lacks", ["a joint", "a pose", "any change"])
def test_torques_that_tell_too_little_are_not_used(lacks):
    """They would take gravity off the joints that they say nothing of: a notice tells."""
    torques = {name: values.copy() for name, values in TAU.items()}
    if lacks == "a joint":
        del torques["tau3"]
    else:
        torques["tau2"][slice(3, 4) if lacks == "a pose" else slice(None)] = np.nan
        torques["tau2"] = torques["tau2"] if lacks == "a pose" else np.zeros(40)
    scene = scene_of(ROBOT, replace(DATA, columns={**DATA.columns, **torques}))
    assert not scene.has_measured_torques
    assert_allclose(scene.gravity, SCENE.gravity, rtol=0, atol=0)
    assert "computed, not read here" in scene.unused_torques_notice
    assert SCENES["torques"].unused_torques_notice == SCENE.unused_torques_notice == ""


def test_torques_of_guessed_masses_stay_so_where_torques_are_measured():
    guessed, measured = (
        scene_of(NO_MASSES, data) for data in (DATA, replace(DATA, columns={**DATA.columns, **TAU}))
    )
    *_, choice = EFFECTS["joint_compliance"].choices(guessed, "J2")
    assert choice["assumed"] == 1.0
    one, other = (columns("joint_compliance", "J2", s, **choice) for s in (guessed, measured))
    assert_allclose(one.turn, other.turn, rtol=0, atol=0)
    assert dict(one.fixed) == {"within_assumed_Nm": choice["within"]}
    assert not any("assumed" in c for c in EFFECTS["joint_compliance"].choices(measured, "J2"))


def test_unknown_masses_give_torques_of_parts():
    scene = SCENES["no masses"]
    choice, *_ = EFFECTS["joint_compliance"].choices(scene, "J2")
    found = columns("joint_compliance", "J2", scene, **choice)
    assert found.names == ("c2 (upper arm)", "c2 (forearm)", "c2 (wrist)")
    # the parts add up to the torque of all links, and none follows from the others
    assert_allclose(found.turn[:, 1].sum(axis=0), scene.gravity[1], rtol=0, atol=EXACT * 1e4)
    assert np.linalg.matrix_rank(found.turn[:, 1]) == 3
    choice, *_ = EFFECTS["joint_compliance"].choices(SCENE, "J2")
    assert len(columns("joint_compliance", "J2", **choice).names) == 1


def test_a_tool_beside_the_flange_weighs_on_the_joints():
    """Its torque is that of its weight on the axis and of two levers, whatever it weighs."""
    scene = SCENES["no masses"]
    plain, choice = EFFECTS["joint_compliance"].choices(scene, "all")
    assert choice == {**plain, "tool": choice["tool"]}
    found = columns("joint_compliance", "all", scene, **choice)
    tool = [name for name in found.names if "tool" in name]
    assert tool == [f"c{j} (tool {a})" for j in range(2, 7) for a in "xy"]  # J1 stands upright
    upward = EFFECTS["joint_compliance"].nonnegative_mask(found)
    assert upward.tolist() == ["tool" not in name for name in found.names]
    on_axis, beside = (
        scene.drive_gravity_torques(
            np.array([0, 0, 0, 0, 0, 3.0]), np.array([[0.0, 0.0, 0.0]] * 5 + [spot])
        )
        for spot in ([0.0, 0.0, 0.1], [0.03, -0.05, 0.1])
    )
    for j in range(1, 6):
        x, y = (found.turn[found.names.index(f"c{j + 1} (tool {a})"), j] for a in "xy")
        expected = on_axis[j] + 3.0 * (0.03 * x - 0.05 * y) / 0.1
        assert_allclose(beside[j], expected, rtol=0, atol=EXACT * 1e3)
    assert len(EFFECTS["joint_compliance"].choices(SCENE, "all")) == 1  # masses are told


def test_doubt_is_the_change_of_torque_for_other_masses():
    """The doubts kept span the most of what one sigma of every mass and centre adds up to."""
    parts = SCENE.gravity_changes_per_sigma[:, 1]
    heavier = ROBOT.mass.copy()
    heavier[1] *= 1.2
    expected = (
        SCENE.drive_gravity_torques(heavier, ROBOT.com)[1]
        - SCENE.drive_gravity_torques(ROBOT.mass, ROBOT.com)[1]
    )
    assert_allclose(parts[0], expected, rtol=0, atol=EXACT * 1e4)
    choice, *_ = EFFECTS["joint_compliance"].choices(SCENE, "J2")
    ((_, moved),) = columns("joint_compliance", "J2", **choice).displacement_uncertainties(SCENE)
    turn = SCENE.jacobian[1]
    kept = np.einsum("rkcm,kcm->rm", moved, turn) / (turn**2).sum(axis=(0, 1))
    whole, told = (part.T @ part for part in (parts, kept))
    left = np.linalg.eigvalsh(whole - told)
    assert left.min() > -1e-9 * left.max()
    assert np.trace(told) > 0.95 * np.trace(whole)


# ---------------------------------------------------------------- bending


def beam(load: float) -> PosedArm:
    """Link 1 is a horizontal bar of 2 m along x; link 2 a point mass 0.5 m beyond it."""
    joints = [
        {"a": 2000.0, "d": 0, "theta": 0, "alpha": 0, "mass_kg": 9.0, "com_mm": [-1000, 0, 0]},
        {"a": 500.0, "d": 0, "theta": 0, "alpha": 0, "mass_kg": load, "com_mm": [0, 0, 0]},
    ]
    units = {"length": "mm", "angle": "rad"}
    robot = robot_from_dict({"name": "beam", "units": units, "joints": joints})
    data = mc.measurements(np.zeros((1, 2)), np.ones((1, 1, 3)))
    spot = np.array([[-0.5, 0.0, 0.0]])  # at the end of the bar
    return PosedArm.at_measured_poses(robot, data, (np.eye(3), np.zeros(3)), spot, data.q)


def test_a_level_link_bends_as_the_cantilever_of_the_textbook():
    """Tip force F and moment F e: FL^3/3 + (F e) L^2/2 down, slope FL^2/2 + F e L, per 1/EI."""
    load, length, beyond = 4.0, 2.0, 0.5
    force = load * STANDARD_GRAVITY
    scene = beam(load)
    sag = -columns("link_bending", "L1", scene).target_displacements(scene)[0, 0, :, 0]
    expected = force * length**3 / 3.0 + force * beyond * length**2 / 2.0
    assert_allclose(sag, [0.0, 0.0, expected], rtol=EXACT, atol=1e-12)
    jacobian = force * length**2 / 2.0 + force * beyond * length
    farther = replace(scene, points=scene.points + np.array([[0.25], [0.0], [0.0]]))
    found = -columns("link_bending", "L1", farther).target_displacements(farther)[0, 0, 2, 0]
    assert_allclose(found, expected + 0.25 * jacobian, rtol=EXACT)


@pytest.mark.parametrize(("effect", "place"), [("link_bending", "L2"), ("base_flex", "frame")])
def test_a_tool_that_nobody_told_bends_as_a_payload_of_a_kilogram(effect, place):
    empty, one = (
        scene_of(NO_MASSES, replace(DATA, columns={**DATA.columns, "payload": np.full(40, mass)}))
        for mass in (0.0, 1.0)
    )
    assert [dict(c) for c in EFFECTS[effect].choices(empty, place)] == [
        {"tool": 0.0},
        {"tool": 1.0},
    ]
    assert [dict(c) for c in EFFECTS[effect].choices(SCENE, place)] == [{}]  # masses are told
    found, plain = (columns(effect, place, empty, tool=t) for t in (1.0, 0.0))
    assert EFFECTS[effect].nonnegative_mask(found).all()
    whole, loaded = (columns(effect, place, s).target_displacements(s)[0] for s in (empty, one))
    links, tool = found.target_displacements(empty)
    scale = np.abs(whole).max()
    assert_allclose(links, whole, rtol=0, atol=0)
    assert_allclose(plain.target_displacements(empty), whole[None], rtol=0, atol=0)
    assert_allclose(tool, loaded - whole, rtol=0, atol=EXACT * scale)
    with_payload = columns(effect, place, one, tool=1.0).target_displacements(one)
    assert_allclose(with_payload, np.stack([loaded, tool]), rtol=0, atol=EXACT * scale)
    owners = [owner for owner, _ in found.displacement_uncertainties(empty)]
    assert owners == [0]  # of the links' masses; the tool's is free


def test_links_that_carry_nothing_do_not_bend():
    assert EFFECTS["link_bending"].places(beam(0.0)) == ()
    assert EFFECTS["link_bending"].places(beam(1.0)) == ("L1",)


def test_base_tilts_by_the_moment_of_all_weight():
    """omega = C M with M = -sum of m (centre of gravity) x g up, payload at the targets."""
    found = columns("base_flex", "frame").target_displacements(SCENE)[0]
    for m in (0, 17, 39):
        pose, moment = np.eye(4), np.zeros(3)
        for i in range(6):
            one = replace(ROBOT, mdh=ROBOT.mdh[: i + 1], sign=ROBOT.sign[: i + 1],
                          prismatic=ROBOT.prismatic[: i + 1])  # fmt: skip
            pose = one.pose(DATA.q[m, : i + 1])
            centre = pose[:3, :3] @ ROBOT.com[i] + pose[:3, 3]
            moment += np.cross(centre, -MASSES[i] * STANDARD_GRAVITY * ROBOT.up)
        tip = pose[:3, :3] @ SPOTS.mean(axis=0) + pose[:3, 3]
        moment += np.cross(tip, -DATA.columns["payload"][m] * STANDARD_GRAVITY * ROBOT.up)
        expected = np.cross(moment, SCENE.points[:, :, m])
        assert_allclose(found[:, :, m], expected, rtol=0, atol=EXACT * np.abs(expected).max())


def test_bracket_sags_to_gravity_and_not_along_it():
    """A bracket along the flange's axis turns by s x g: not at all where it hangs or stands."""
    pose = ROBOT.pose(DATA.q)
    axis = pose[:, :3, 2]
    found = columns("tool_flex", "all", lever=1.0).target_displacements(SCENE)
    turn = np.cross(axis, -ROBOT.up)
    arm = SCENE.points - pose[:, :3, 3].T
    expected = np.cross(turn.T[None], arm, axis=1)
    assert_allclose(found[0], expected, rtol=0, atol=EXACT)
    drawn = axis * -(axis @ ROBOT.up)[:, None]
    assert_allclose(found[1], np.broadcast_to(drawn.T, found[1].shape), rtol=0, atol=EXACT)


def test_spring_pulls_as_the_length_of_a_real_spring_has_it():
    """Torque is the slope of (s - s0)^2 / 2 by the lean, up to the factor a that k holds."""
    zero, eye, rest = 0.2, 0.5, 0.4
    lean = ROBOT.mdh[1, 2] + SCENE.q[1] + np.pi / 2  # from the base's own vertical
    level = scene_of(replace(ROBOT, up=np.array([0.0, 0.0, 1.0])), DATA)
    found = columns("gravity_compensator", "J2", level, zero=zero, eye=eye, rest=rest)
    b = lean - zero + 1e-30j
    length = np.sqrt(1.0 + eye**2 - 2.0 * eye * np.cos(b))
    jacobian = (0.5 * (length - rest) ** 2).imag / 1e-30
    assert_allclose(found.turn[0, 1], jacobian / eye, rtol=0, atol=EXACT)


# ---------------------------------------------------------------- gears


def test_waves_repeat_so_many_times_a_turn():
    found = columns("gear_error", "J3", turns=2.0)
    assert_allclose(found.turn[0, 2] + 1j * found.turn[1, 2], np.exp(2j * SCENE.q[2]), rtol=EXACT)
    assert found.fixed == {"waves_per_turn": 2.0}
    ratio = EFFECTS["gear_ripple"].choices(SCENE, "J3")
    assert [choice["turns"] for choice in ratio] == [101.0, 202.0]
    later = replace(SCENE.data, q=SCENE.data.q + 2.0 * np.pi / 101.0)
    again = columns("gear_ripple", "J3", scene_of(ROBOT, later), turns=101.0)
    assert_allclose(again.turn, columns("gear_ripple", "J3", turns=101.0).turn, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("found", "orders"),
    [([{"turns": 1.0}], 2.0), ([{"turns": 2.0}, {"turns": 3.0}], 3.0), ([{"orders": 2.0}], 2.0)],
)
def test_a_gear_error_has_all_orders_up_to_the_highest_found(found, orders):
    assert EFFECTS["gear_error"].entire(found, ()) == [{"orders": orders}]
    alike = [{**choice, "joints": 6.0} for choice in found]  # of several joints at once
    assert EFFECTS["gear_error"].entire(alike, ()) is alike
    beside = [{"turns": 1.0, "joints": 6.0}]
    rest = [{"turns": float(k)} for k in range(2, int(orders) + 1)]
    assert list(EFFECTS["gear_error"].entire(found, beside)) == rest


def test_the_whole_of_a_law_can_be_asked_for():
    (term,) = parse_effect_terms(SCENE, ["gear_error:J2:orders=3"])
    assert term.choice == {"orders": 3.0}
    with pytest.raises(mc.CalibrationError, match="no orders 4; choose 2, 3"):
        parse_effect_terms(SCENE, ["gear_error:J2:orders=4"])


def test_gain_and_coupling_turn_in_proportion():
    assert_allclose(columns("encoder_gain", "J3").turn[0, 2], -DATA.q[:, 2], rtol=0, atol=0)
    turn = columns("joint_coupling", "J5", source=4.0).turn
    assert_allclose(turn[0, 4], DATA.q[:, 3], rtol=0, atol=0)
    assert np.count_nonzero(turn.any(axis=2)) == 1


def test_play_is_half_the_backlash_towards_the_last_move():
    joint, sign = 2, ROBOT.sign[2]
    turn = columns("backlash", "J3").turn[0, joint]
    moves = np.sign(np.diff(DATA.q[:, joint])) * sign
    assert_allclose(turn, [0.0, *(0.5 * moves)], rtol=0, atol=0)
    side = np.where(np.arange(40) % 3, 1.0, -1.0)
    told = replace(DATA, columns={**DATA.columns, "approach3": side})
    found = columns("backlash", "J3", scene_of(ROBOT, told)).turn[0, joint]
    assert_allclose(found, 0.5 * side * sign, rtol=0, atol=0)


def test_settling_is_a_share_of_the_last_move():
    turn = columns("settling", "J2").turn[0, 1]
    assert_allclose(turn, [0.0, *np.diff(DATA.q[:, 1])], rtol=0, atol=0)


def test_slides_settle_too():
    slide = SCENES["a slide"]
    assert "J3" in EFFECTS["settling"].places(slide)
    assert "J3" not in EFFECTS["backlash"].places(slide)  # whose play is told in radians
    way = columns("settling", "J3", slide).turn[0, 2]
    assert_allclose(way, [0.0, *np.diff(slide.q[2])], rtol=0, atol=0)


# ---------------------------------------------------------------- time


def test_warm_arm_is_the_arm_with_longer_links():
    """A strain of 1e-5 a kelvin against forward kinematics with lengths scaled."""
    strain = 1e-5
    term = Term("thermal_growth", "all", {"temperature": 1.0})
    moved = Fitted((term,), (np.array([strain]),)).displaced_targets(SCENE)
    scale = 1.0 + strain * (DATA.columns["temperature"] - REFERENCE_TEMPERATURE_C)
    long = np.array([[0, 1], [1, 0], [0, 0], [0, 1], [0, 0], [0, 0]])  # d1, a2, d4
    for m in (0, 21):
        mdh = ROBOT.mdh.copy()
        mdh[:, :2] *= np.where(long > 0, scale[m], 1.0)
        pose = ROBOT.with_mdh(mdh).pose(DATA.q[m])
        assert_allclose(moved[:, :, m], SPOTS @ pose[:3, :3].T + pose[:3, 3], rtol=0, atol=1e-12)


def test_strains_apart_add_up_to_the_common_one():
    apart = columns("thermal_growth", "all", constant=0.5, apart=1.0)
    assert apart.names == ("strain d1", "strain a2", "strain d4")
    common = columns("thermal_growth", "all", constant=0.5).target_displacements(SCENE)
    assert_allclose(apart.target_displacements(SCENE).sum(axis=0), common[0], rtol=0, atol=EXACT)


def test_growth_slows_down_with_its_time_constant():
    clock = SCENE.column("clock")
    straight = columns("thermal_growth", "all", constant=np.inf).shift[0, 0]
    curved = columns("thermal_growth", "all", constant=0.3).shift[0, 0]
    late = clock > 0.0
    share = (1.0 - np.exp(-clock / 0.3)) / np.where(late, clock, 1.0)
    assert_allclose(curved[:, late], (straight * share)[:, late], rtol=1e-10, atol=1e-12)
    assert_allclose(clock, (DATA.columns["time"] - DATA.columns["time"].min())
                    / np.ptp(DATA.columns["time"]), rtol=0, atol=EXACT)  # fmt: skip


def test_a_temperature_that_was_not_read_is_not_zero_degrees():
    term = Term("thermal_growth", "all", {"temperature": 1.0})
    gone = DATA.columns["temperature"].copy()
    gone[3] = np.nan
    scene = scene_of(ROBOT, replace(DATA, columns={**DATA.columns, "temperature": gone}))
    field, whole = term.columns(scene).shift, term.columns(SCENE).shift
    ratio = (np.nanmean(gone) - REFERENCE_TEMPERATURE_C) / (
        DATA.columns["temperature"][3] - REFERENCE_TEMPERATURE_C
    )
    assert_allclose(field[..., 3], ratio * whole[..., 3], rtol=0, atol=EXACT * 100)
    never = {k: v for k, v in DATA.columns.items() if k != "temperature"}
    scene = scene_of(ROBOT, replace(DATA, columns=never))
    assert not term.columns(scene).shift.any()


def test_the_base_drifts_as_one_body():
    found = columns("frame_drift", "frame", constant=np.inf)
    clock, p = SCENE.column("clock"), SCENE.points
    assert_allclose(found.shift[1, :, 1], np.broadcast_to(clock, (3, 40)), rtol=0, atol=EXACT)
    assert not found.shift[1, :, [0, 2]].any()
    expected = clock * np.stack([-p[:, 1], p[:, 0], 0.0 * p[:, 2]], axis=1)  # turn about z
    assert_allclose(found.shift[5], expected, rtol=0, atol=EXACT)


def in_sessions(names: str) -> tuple[Array, PosedArm]:
    """Rows of sessions by turns, of which three have frames."""
    columns = {**DATA.columns, "session": np.array([*names])[np.arange(40) % 4]}
    data = replace(DATA, frames={name: np.eye(4) for name in "abc"}, columns=columns)
    return columns["session"], scene_of(ROBOT, data)


def test_a_jump_is_the_base_elsewhere_in_each_further_session():
    session, scene = in_sessions("abcb")
    found = columns("session_jump", "frame", scene, sessions=3.0)
    assert found.names == tuple(f"{n}{i}" for i in "23" for n in ("x", "y", "z", "rx", "ry", "rz"))
    p = scene.points
    turned = np.stack([0.0 * p[:, 0], -p[:, 2], p[:, 1]], axis=1)  # about x
    for at, name in ((3, "b"), (9, "c")):
        assert_allclose(found.shift[at], turned * (session == name), rtol=0, atol=EXACT)
    after = columns("session_jump", "frame", since=0.4)
    assert_allclose(after.shift[0, :, 0], np.broadcast_to(SCENE.column("clock") >= 0.4, (3, 40)))


def test_a_zero_is_otherwise_before_the_last_rows():
    """The geometry is that of the last session; rows of no known session are as the last ones."""
    session, scene = in_sessions("abcx")
    since = columns("encoder_zero", "J3", scene, session=2.0).turn[0]
    assert_allclose(since[2], np.where(session == "a", -1.0, 0.0), rtol=0, atol=0)
    assert not np.delete(since, 2, axis=0).any()
    alone = columns("encoder_zero", "J3", scene, session=2.0, alone=1.0).turn[0, 2]
    assert_allclose(alone, session == "b", rtol=0, atol=0)
    moment = columns("encoder_zero", "J3", since=0.4).turn[0, 2]
    assert_allclose(moment, np.where(SCENE.column("clock") >= 0.4, 0.0, -1.0), rtol=0, atol=0)
    later = replace(scene, data=replace(scene.data, frames={}))
    assert not columns("encoder_zero", "J3", later, session=2.0).turn.any()


def test_a_nest_moves_in_the_flange_after_its_moment():
    since = float(SCENE.column("clock")[15])
    move = np.array([1e-3, -2e-3, 5e-4])
    term = Term("target_shift", "smr2", {"since": since})
    moved = Fitted((term,), (move,)).displaced_targets(SCENE)
    spots = SPOTS + np.array([[0.0], [1.0], [0.0]]) * move
    after = scene_of(ROBOT, DATA).robot.pose(DATA.q)
    there = np.einsum("mij,kj->kim", after[:, :3, :3], spots) + after[:, :3, 3].T
    assert_allclose(moved[..., 15:], there[..., 15:], rtol=0, atol=EXACT)
    assert_allclose(moved[..., :15], SCENE.points[..., :15], rtol=0, atol=0)


def test_an_offset_lies_on_the_line_of_sight():
    """The instrument is the origin of the measurement frame; one target, and all of them."""
    rotation, origin = BASE
    seen = np.einsum("ij,kjm->kim", rotation, SCENE.points) + origin[:, None]
    away = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    for place, chosen in (("smr3", [2]), ("all", [0, 1, 2])):
        shift = columns("target_offset", place).shift[0]
        turned = np.einsum("ij,kjm->kim", rotation, shift)
        assert_allclose(turned[chosen], away[chosen], rtol=0, atol=EXACT)
        assert not np.delete(turned, chosen, axis=0).any()


@pytest.mark.parametrize("name", ["irb2600", "ur10", "scara_600", "meca500"])
def test_the_simulator_has_the_gravity_of_the_laws(name, rng):
    """Whether masses are told or those of tubes, each of which hangs midway between its ends."""
    robot = mc.load_robot(name)
    n, signs = robot.joints, rng.choice([-1.0, 1.0], robot.joints)
    told = replace(robot, mass=rng.uniform(1, 40, n), com=rng.normal(size=(n, 3)), sign=signs)
    for arm in (robot, told):
        q = random_joint_values_above_floor(arm, 20, rng)
        scene = Cell(arm, np.eye(4), ("smr1",), np.zeros((1, 3))).pose_arm(
            build_measurements_at_rest(q, ("smr1",), arm)
        )
        assert_allclose(gravity(arm, q), scene.gravity.T * arm.sign, rtol=0, atol=EXACT * 1e4)
    mass = ASSUMED_LINK_MASS_PER_METRE * np.linalg.norm(robot.mdh[:, :2], axis=1)

    def energy(q: Array) -> Array:
        ends = kinematics.compute_link_frames(robot.mdh, q * robot.sign, robot.prismatic).after
        middle = 0.5 * (ends + np.concatenate([0.0 * ends[:1], ends[:-1]]))
        return np.asarray(STANDARD_GRAVITY * np.einsum("n,ncm,c->m", mass, middle, robot.up))

    for j in np.flatnonzero(~robot.prismatic):
        slope = energy(
            random_joint_values_above_floor(robot, 5, np.random.default_rng(1))
            + 1e-30j * np.eye(n)[j]
        )
        found = gravity(robot, random_joint_values_above_floor(robot, 5, np.random.default_rng(1)))[
            :, j
        ]
        assert_allclose(found, -slope.imag / 1e-30, rtol=0, atol=EXACT * 1e4)


def test_a_law_of_the_wrong_shape_is_an_error_in_words():
    from minimax_cal.core.errors import OptionError
    from minimax_cal.modelling.effects.scene import EffectColumns
    from minimax_cal.modelling.effects.table import check_effect_columns
    from minimax_cal.reporting.diagnosis_tables import build_minimal_posed_arm

    scene = build_minimal_posed_arm()
    right = np.zeros((1, scene.joints, scene.poses))
    check_effect_columns("mine:J1", EffectColumns(("c",), ("rad",), turn=right), scene)
    with pytest.raises(
        OptionError, match=r"effect mine:J1: turn has the shape .*; give \(1, 6, 1\)"
    ):
        check_effect_columns("mine:J1", EffectColumns(("c",), ("rad",), turn=right[:, :-1]), scene)
    with pytest.raises(OptionError, match="its law returned ndarray; give Columns"):
        check_effect_columns("mine:J1", right, scene)

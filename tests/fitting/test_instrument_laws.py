"""Effects of an arm in one fit of several instruments: each sees them through its own rows."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.relative import NOISE, SIMULATORS, Arm
from minimax_cal.evidence.noise import restricted
from minimax_cal.fitting.opened import open_result
from minimax_cal.fitting.several import relative
from minimax_cal.fitting.several.fit import InstrumentFit, Train, fit_instruments, laws_of
from minimax_cal.fitting.several.linear import rows_of_all, scene_of_all
from minimax_cal.fitting.several.options import RelativeOptions, silent
from minimax_cal.instruments import Instrument, Surface, contacts
from minimax_cal.instruments.file import as_instrument
from minimax_cal.measuring.history import with_history
from minimax_cal.robots.gravity import tubes
from minimax_cal.robots.sampling import random_poses

COMPLIANCE = 3e-7  # of every joint [rad/(N m)]
PLAIN = mc.load_robot("irb2600")
MASS, COM = tubes(PLAIN.mdh)
TOLD = replace(PLAIN, mass=np.maximum(MASS, 1.0), com=COM)  # one compliance a joint
ASKED = ("joint_compliance:J2", "joint_compliance:J3")
SEVERAL = (*ASKED, "link_bending:L2", "base_flex", "gear_error:J1:turns=1")


def arm_of(seed: int) -> Arm:
    return Arm(TOLD, TOLD.with_mdh(Arm.of("irb2600", seed, 0.0).real.mdh), COMPLIANCE)


def tracker(arm: Arm, rng: np.random.Generator, poses: int) -> Instrument:
    q = random_poses(arm.robot, poses, rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    y = arm.place(q) @ turn.T + shift + NOISE * rng.normal(size=(poses, 3))
    return as_instrument(mc.measurements(q, y))


def plates(arm: Arm, rng: np.random.Generator, count: int) -> Instrument:
    """Contacts with four planes that stand where the ball happened to be: no pose is special."""
    q, labels = random_poses(arm.robot, 4 * count, rng), np.repeat(list("ABCD"), count)
    return contacts(q, labels, [Surface(label) for label in "ABCD"])


KINDS = ("tracker", "wires_3", "closures_known", "poses")


@cache
def measured(seed: int, kinds: tuple[str, ...]) -> tuple[Arm, tuple[Instrument, ...], tuple]:
    arm, rng = arm_of(seed), np.random.default_rng([seed, 5])
    data, known = [], ()
    for kind in kinds:
        if kind == "tracker":
            data.append(tracker(arm, rng, 60))
            continue
        made = SIMULATORS[kind](arm, rng, 100, NOISE)
        data.append(made.data)
        known = made.known or known
    return arm, tuple(data), known


def fitted(kinds: tuple[str, ...], effects: tuple[str, ...] = ()) -> tuple[Arm, InstrumentFit]:
    arm, data, known = measured(0, kinds)
    every = [replace(each, at=with_history(each.at)) for each in data]
    trains = [Train(f"file{i}", each) for i, each in enumerate(every)]
    options = RelativeOptions(known_distances=known, effects=effects)
    return arm, fit_instruments(arm.robot, trains, options, silent)


@pytest.mark.parametrize("kind", [*KINDS, "contacts"])
def test_the_rows_of_an_arm_that_gives_way_have_its_derivative(kind):
    """By central differences, of links, of the instrument's own and of the laws.

    But for a turn of the base of points: their rows are along its axes, and turn with it.
    """
    arm, rng = arm_of(1), np.random.default_rng(3)
    if kind == "contacts":
        data = [replace(plates(arm, rng, 30), at=with_history(plates(arm, rng, 30).at))]
        train = Train("plates", data[0])
        options = RelativeOptions(fix=("*",))
        fit = fit_instruments(arm.robot, [train], options, silent)
    else:
        arm, fit = fitted((kind,))
        train = fit.trains[0]
    laws = laws_of(arm.robot, fit, SEVERAL)
    stack, x = fit.stack.bent(arm.robot, laws, fit.state)
    first = stack.names.geometric
    turns = [name.startswith("base_r") for name in stack.names.all]
    active = stack.movable & ~np.array(turns)
    size = np.abs(stack.rows(x, active)[1][-len(laws.names) :]).max(axis=1)
    x.effects[stack.lawless - first :] = 1e-5 * rng.normal(size=len(size)) / size  # some 10 um
    _, slope = stack.rows(x, active)
    for row, at in zip(slope, np.flatnonzero(active), strict=True):
        step, size = np.zeros(stack.names.count), max(float(np.abs(row).max()), 1.0)
        step[at] = 1e-6 / size
        ends = [stack.rows(x.step(sign * step), ~active)[0] for sign in (1, -1)]
        assert_allclose(
            row / size, (ends[1] - ends[0]) / 2e-6, atol=3e-8, err_msg=stack.names.all[at]
        )


def test_an_arm_at_other_poses_gives_way_by_the_same_laws():
    """At the training poses `at_rows_of` predicts what the rows do."""
    for kind in KINDS:
        arm, fit = fitted((kind,), ASKED)
        data = fit.trains[0].data
        stack, x = fit.stack, fit.stack.part(fit.state, 0)
        block = stack.blocks[0].at_rows_of(arm.robot, data, stack.laws, x)
        held = np.zeros(data.poses, dtype=bool)
        error = block.instrument.errors(block.flange(x), block.own(x), held)
        assert 0.5 * NOISE < np.sqrt(np.nanmean(error**2)) < 2.0 * NOISE


PULLED = (("wires_3",), ("closures_known",), ("poses",), ("tracker", "closures_known"))


@pytest.mark.parametrize("kinds", PULLED)
def test_the_compliance_is_found_to_its_sigma(kinds):
    pulls = []
    for seed in range(8):
        arm, data, known = measured(seed, kinds)
        fit = relative(arm.robot, list(data), known_distances=known, effects=ASKED)
        found = [p for p in fit.parameters if p.of_effect]
        assert [p.name for p in found] == ["joint_compliance:J2.c2", "joint_compliance:J3.c3"]
        assert all(p.sigma < 0.3 * COMPLIANCE for p in found)
        pulls += [(p.value - COMPLIANCE) / p.sigma for p in found]
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.5  # sixteen: 0.65 to 1.4 in 95 %
    assert np.abs(pulls).max() < 3.5


def test_with_its_effects_an_arm_is_met_as_no_stiff_one_is():
    for kinds in PULLED:
        arm, data, known = measured(1, kinds)
        plain = relative(arm.robot, list(data), known_distances=known)
        bent = relative(arm.robot, list(data), known_distances=known, effects=ASKED)
        before, after = (fit.accuracy["holdout"].rms_mm for fit in (plain, bent))
        assert after < 0.6 * before
        assert after < 2.5e3 * NOISE
        # the robot of the file is that of geometry alone
        assert_allclose(bent.robot.mdh, plain.robot.mdh, rtol=0, atol=1e-12)
        assert plain.cell is None


def test_a_joint_that_does_not_give_way_rests_at_its_bound():
    arm, rng = Arm(TOLD, arm_of(2).real, -2e-7), np.random.default_rng(8)
    data = SIMULATORS["wires_3"](arm, rng, 100, NOISE).data
    fit = relative(arm.robot, data, effects="joint_compliance:J2")
    (found,) = (p for p in fit.parameters if p.of_effect)
    assert (found.value, found.identifiable, found.reason) == (0.0, False, "at its bound")


# ---- the rows of evidence ----------------------------------------------------------------------


@pytest.mark.parametrize("kinds", [*((kind,) for kind in KINDS), KINDS])
def test_the_rows_of_evidence_estimate_what_the_fit_does(kinds):
    """One Gauss-Newton step from geometry alone, weighed alike, geometry projected out."""
    arm, fit = fitted(kinds)
    scene = scene_of_all(arm.robot, fit)
    rows = rows_of_all(scene, fit)
    found = laws_of(arm.robot, fit, ASKED)
    field = np.concatenate([term.columns(scene).displacement(scene) for term in found.terms])
    columns = rows.of(field)
    clear = columns - rows.basis @ (rows.basis.T @ columns)
    value = np.linalg.lstsq(clear, rows.error, rcond=None)[0]
    stack, x = fit.stack.bent(arm.robot, found, fit.state)
    active = np.pad(fit.identification.active, (0, 2), constant_values=True)
    weight = np.sqrt(stack.weights(x))  # a known distance counts as a coordinate in evidence
    error, slope = stack.rows(x, active)
    step = np.linalg.lstsq((slope / weight).T, error / weight, rcond=1e-12)[0]
    assert_allclose(value, step[-2:], rtol=1e-6)


@pytest.mark.parametrize("kinds", [*((kind,) for kind in KINDS), KINDS])
def test_the_rows_of_a_stiff_arm_have_the_noise_of_their_instruments(kinds):
    arm, fit = fitted(kinds, ASKED)
    scene = scene_of_all(arm.robot, fit)
    rows = rows_of_all(scene, fit)
    noise = restricted(rows, np.zeros((len(rows.error), 0)))
    assert noise.variance == pytest.approx(float(fit.noise.min()) ** 2, rel=0.2)
    assert noise.jitter < 5e-6
    numbers = sum(
        6 * one.poses if one.kind == "poses" else len(fit.stack.blocks[i].read(part).weights)
        for i, one in enumerate(fit.stack.instruments)
        for part in [fit.stack.part(fit.state, i)]
    )
    assert rows.count == numbers


# ---- the file ----------------------------------------------------------------------------------


def test_a_file_predicts_with_its_effects(tmp_path):
    arm, data, _ = measured(3, ("wires_3", "closures"))
    fit = relative(arm.robot, list(data), effects=ASKED)
    path = tmp_path / "fit.json"
    fit.save(path)
    again = open_result(path)
    assert fit.cell is not None
    assert_allclose(again.cell.robot.mdh, fit.cell.robot.mdh, rtol=0, atol=1e-12)
    assert [t.label for t in again.cell.effects.terms] == list(ASKED)
    assert again.geometric is not None
    assert_allclose(again.geometric.robot.mdh, fit.robot.mdh, rtol=0, atol=1e-12)
    seen = tracker(arm, np.random.default_rng(12), 80).at
    cell, _, _ = again.placed_by(seen)
    stiff, _, _ = replace(again, rungs=(again.rungs[0], replace(
        again.rungs[1], cell=again.geometric))).placed_by(seen)  # fmt: skip
    met, missed = (float(np.sqrt(np.mean(one.error(seen) ** 2))) for one in (cell, stiff))
    assert met < 2.0 * NOISE < 0.5 * missed


def test_what_carries_no_effect_holds_the_geometry_fitted_alone(tmp_path):
    arm, data, _ = measured(3, ("wires_3", "closures"))
    fit = relative(arm.robot, list(data), effects=ASKED)
    made = mc.deliver(fit, "urdf")
    assert made.not_carried == ASKED
    assert_allclose(made.cell.robot.mdh, fit.robot.mdh, rtol=0, atol=1e-12)
    held = mc.deliver(fit, "mjcf")
    assert held.carries == ASKED
    assert_allclose(held.cell.robot.mdh, fit.cell.robot.mdh, rtol=0, atol=1e-12)


def test_effects_that_are_no_arms_or_lack_something_are_refused(tmp_path):
    arm, data, _ = measured(3, ("wires_3", "closures"))
    for effect, words in (
        ("target_offset", "belongs to one instrument, not to the arm that all share"),
        ("backlash:J1", "lacks columns approach1"),
        ("nonsense", "no effect 'nonsense'"),
        ("joint_compliance:J9", "no place 'J9'"),
    ):
        with pytest.raises(mc.OptionError, match=words):
            relative(arm.robot, list(data), effects=effect)

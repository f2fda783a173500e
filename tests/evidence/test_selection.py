"""Selection by evidence: names what is there, nothing where nothing is, and knows its rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

import minimax_cal as mc
from experiments.gap_cases import Case, Cause, make
from experiments.resemblance import resemblance
from minimax_cal.diagnosing.causes import select_effects
from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.evidence import selection
from minimax_cal.evidence.bench import against_signs, bench, columns_of, credible
from minimax_cal.evidence.library import Kind, Library, Spec
from minimax_cal.evidence.limits import LEVEL, PARTS, ROUNDS
from minimax_cal.evidence.noise import Noise, Problem, orthonormal
from minimax_cal.evidence.selection import select, tuned
from minimax_cal.evidence.stability import Repeats, alternatives, halves, repeated, subsamples
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.dictionary import ArmLaws, arm_library
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.gravity import masses_of
from minimax_cal.robots.robot import Robot

# ---- selection -----------------------------------------------------------------------------------


def opened(*causes: Cause, seed: int = 0, robot: str = "irb2600", poses: int = 100) -> Study:
    sealed = make(Case(robot, "single", causes, seed=seed, poses=poses))
    train, _, _ = split(with_history(sealed.data), 0.2, 0)
    return study_of(sealed.robot, train)


def study_of(robot: mc.Robot, data: mc.Measurements) -> Study:
    return studied(robot, data, fit_cell(robot, data, Options(objective="sum"), silent))


@pytest.mark.parametrize(
    ("law", "place"),
    [
        ("joint_compliance", "J3"),
        ("gear_ripple", "J1"),
        ("encoder_gain", "J4"),
        ("joint_coupling", "J6"),
        ("thermal_growth", "all"),
        ("tool_flex", "all"),
        ("target_offset", "smr1"),
    ],
)
def test_a_plain_effect_is_named_and_sized(law, place):
    """lambda = 1000: effect and place exactly, and the noise is found beside it."""
    choice = select_effects(opened(Cause(law, place, 1000.0), seed=11), ())
    assert [c.key for c in choice.chosen] == [(law, place)]
    assert 12e-6 < np.sqrt(choice.noise.variance) < 25e-6


def test_a_joint_that_stiffens_is_told_as_its_compliance():
    """By a machine whose law is not ours: tau / (1 + 2 |tau| / most)."""
    choice = select_effects(opened(Cause("joint_compliance/hardening", "J3", 5000.0), seed=11), ())
    (one,) = choice.chosen
    assert one.key == ("joint_compliance", "J3")
    assert one.term.choice["within"] > 0.0
    assert 12e-6 < np.sqrt(choice.noise.variance) < 25e-6


def test_masses_in_doubt_excuse_what_little_they_explain():
    """And not a law that is missing, for which they would have to be many sigma off."""
    robot = mc.load_robot("ur10")
    mass, com = masses_of(robot)
    robot = replace(robot, mass=mass, com=com)
    made = simulate(robot, poses=150, seed=1, truth=Truth(compliance=2e-6))
    off = replace(robot, mass=mass * [1.0, 1.15, 0.9, 1.2, 1.0, 0.85])
    told = study_of(off, with_history(made.data))
    for exclude, excused in (((), True), (("joint_compliance",), False)):
        choice = select_effects(told, exclude)
        main, loose, _ = columns_of(choice.chosen, choice.found)
        assert len(loose)
        assert credible(choice.library, choice.found, choice.noise) == excused
        assert choice.doubted.shape[1] == len(main) + excused * len(loose)


def test_no_name_without_an_effect():
    for seed in range(5):
        choice = select_effects(opened(seed=100 + seed), ())
        assert choice.chosen == ()


def test_two_effects_are_both_named():
    made = opened(Cause("backlash", "J1", 300.0), Cause("gear_error", "J3", 300.0), seed=4)
    choice = select_effects(made, ())
    assert {c.key for c in choice.chosen} == {("backlash", "J1"), ("gear_error", "J3")}


def test_rivals_hold_the_truth_where_it_cannot_be_told():
    """A tilting base looks like a yielding second joint: whatever is named, both are in the set."""
    for seed in (1, 2):
        choice = select_effects(opened(Cause("base_flex", "frame", 60.0), seed=seed), ())
        table, named = choice.beside_others(0)
        found = alternatives(table, named)
        names = {named.candidate.key, *(other.candidate.key for other, _, _ in found)}
        assert ("base_flex", "frame") in names
        for _, rho2, power in found:
            assert 0.0 <= rho2 <= 1.0
            assert power >= 0.0


def test_two_effects_that_are_both_there_are_no_rivals():
    """Fits as good as one another, of which each is needed beside the other."""
    names = (("encoder_gain", "J2"), ("backlash", "J2"))
    made = opened(*(Cause(*name, 300.0) for name in names), seed=4)
    lib = arm_library(made.scene, made.rows)
    table = bench(lib, ())
    pair = [next(c for c in lib.candidates if c.key == name) for name in names]
    for one, other in (pair, pair[::-1]):
        best = table.added(one)
        assert other.key not in {found.candidate.key for found, _, _ in alternatives(table, best)}
        beside = bench(lib, (other,))  # at noises of its own: the gain is the same to a tenth
        expected = beside.chance(beside.added(one))
        found = table.p_beside(best, other) / table.looked_at(one)
        assert_allclose(np.log(found), np.log(expected), rtol=0.1)


def test_a_cause_and_what_resembles_it_stay_rivals():
    """The one that is not there is of no use beside the truth, five times of five."""
    for seed in range(5):
        made = opened(Cause("joint_compliance", "J2", 400.0), seed=seed)
        lib = arm_library(made.scene, made.rows)
        table = bench(lib, ())
        names = (("joint_compliance", "J2"), ("base_flex", "frame"))
        truth, like = (next(c for c in lib.candidates if c.key == name) for name in names)
        assert table.p_beside(table.added(like), truth) >= LEVEL
        assert table.p_beside(table.added(truth), truth) == 1.0


def test_lambda_is_the_one_that_was_asked_for():
    """The generator's detectability and the diagnosis' agree to 35 %, masses being 15 % off."""
    made = opened(Cause("joint_compliance", "J3", 400.0), seed=6)
    choice = select_effects(made, ())
    table, one = choice.beside_others(0)
    size, rho2 = table.likeness(one, one.candidate)
    assert abs(size / 400.0 - 1.0) < 0.35
    assert rho2 > 1.0 - 1e-6


def test_values_are_those_of_least_squares():
    """Without jitter the fit beside the geometry is plain least squares on both."""
    made = opened(Cause("encoder_gain", "J2", 500.0), seed=8)
    lib = arm_library(made.scene, made.rows)
    c = next(c for c in lib.candidates if c.key == ("encoder_gain", "J2"))
    settings = selection.bench(lib, ()).settings
    still = int(np.flatnonzero(settings.ratios == 0.0)[0])
    gain, value, *_ = (x[still] for x in settings.added_all(Kind.of([c]), 1))
    matrix = np.concatenate([made.rows.basis, lib.columns[:, c.main]], axis=1)
    expected, squares, *_ = np.linalg.lstsq(matrix, made.rows.error, rcond=None)
    assert_allclose(value[0, 0], expected[-1], rtol=1e-8)
    assert_allclose(settings.total[still] - gain[0], squares[0], rtol=1e-8)


def yielding(study: Study, tool: Array, stiff: Array) -> Study:
    """The study of an arm without told masses that gives way, with 4 kg on its flange.

    tool: (3,) where they hang in the last frame [m].  stiff: (n,) compliances [rad/(N m)].
    """
    robot = study.scene.robot
    scene = replace(study.scene, robot=replace(robot, mass=np.full(6, np.nan)))
    mass, com = (part.copy() for part in scene.masses)
    com[-1] = (mass[-1] * com[-1] + 4.0 * tool) / (mass[-1] + 4.0)
    mass[-1] += 4.0
    torque = scene.torque(mass, com)
    moved = np.einsum("n,nm,nkcm->kcm", stiff, torque, scene.jacobian)
    rows = study.rows
    rest = rows.of(moved[None])[:, 0]
    rest -= rows.basis @ (rows.basis.T @ rest)
    return replace(study, scene=scene, rows=replace(rows, error=rows.error + rest))


SOFT = np.array([0.0, 1e-6, 1.5e-6, 1e-5, 1.5e-5, 4e-5])


def test_the_weight_of_an_untold_tool_is_found_beside_the_axis():
    made = yielding(opened(seed=3, poses=200), np.array([0.06, -0.08, 0.1]), SOFT)
    choice = select_effects(made, ())
    (one,) = choice.chosen
    assert one.key == ("joint_compliance", "all")
    assert "tool" in one.term.choice
    value, sigma = choice.estimates[0]
    assert (value > -4.0 * sigma)[one.upward].all()
    names = one.term.columns(made.scene).names
    for j, a, lever in ((5, "x", 0.06), (5, "y", -0.08), (6, "x", 0.06), (6, "y", -0.08)):
        i = names.index(f"c{j} (tool {a})")
        assert abs(value[i] - SOFT[j - 1] * 4.0 * lever / 0.1) < 4.0 * sigma[i]


def test_a_tool_on_the_axis_needs_no_levers():
    made = yielding(opened(seed=3, poses=200), np.array([0.0, 0.0, 0.1]), SOFT)
    choice = select_effects(made, ())
    assert [c.key for c in choice.chosen] == [("joint_compliance", "all")]
    assert "tool" not in choice.chosen[0].term.choice


def test_what_signs_cost_is_the_rise_of_the_bounded_square():
    """Against least squares with bounds on all rows: no compliance below 0."""
    made = yielding(opened(seed=5), np.array([0.0, 0.0, 0.1]), -SOFT)
    lib = arm_library(made.scene, made.rows)
    terms = ["joint_compliance:all", "backlash:J1", "link_bending:L2"]
    found = {c.term.label: c for c in lib.candidates if not c.term.choice.get("tool")}
    fits, chosen_ = [], []
    for text in terms:
        fits.append(selection.bench(lib, chosen_, fits).added(found[text]))
        chosen_.append(found[text])
    noise = selection.noise_beside(lib, fits)
    main, loose, ridge = selection.columns_of(chosen_, fits)
    weight = noise.weights(made.rows)
    free = np.column_stack([made.rows.basis, lib.columns[:, main], lib.columns[:, loose]])
    count, none = made.rows.basis.shape[1], np.zeros((len(loose), free.shape[1]))
    none[:, free.shape[1] - len(loose) :] = np.diag(np.sqrt(ridge))
    matrix = np.concatenate([free * np.sqrt(weight)[:, None], none])
    scale = np.linalg.norm(matrix, axis=0)
    right = np.concatenate([made.rows.error * np.sqrt(weight), np.zeros(len(loose))])
    low = np.full(matrix.shape[1], -np.inf)
    upward = np.concatenate([c.upward for c in chosen_])
    low[count : count + len(upward)][upward] = 0.0
    bounded, plain = (
        2.0 * lsq_linear(matrix / scale, right, (least, np.inf), method="bvls", tol=1e-12).cost
        for least in (low, np.full_like(low, -np.inf))
    )
    assert bounded - plain > 100.0
    assert_allclose(against_signs(lib, fits, noise), bounded - plain, rtol=1e-5)
    for c, (value, sigma) in zip(chosen_, selection.together(lib, fits, noise), strict=True):
        assert (value >= -1e-9 * sigma)[c.upward].all()


def test_the_open_variant_is_chosen_by_evidence():
    """A text leaves the moment of the shift open: the fit then uses the right one."""
    import minimax_cal as mc

    sealed = make(Case("irb2600", "single", (Cause("target_shift", "smr2", 2000.0),), seed=9))
    fit = mc.calibrate(sealed.robot, sealed.data, objective="sum", effects=["target_shift:smr2"])
    truth = float(np.sqrt((sealed.floor * 1e3) ** 2))
    assert fit.accuracy["holdout"].rms_mm < 1.1 * truth


def test_resemblance_knows_the_law():
    sealed = make(Case("irb2600", "single", (Cause("gear_error", "J3", 300.0),), seed=1))
    alike = resemblance(sealed.robot, sealed.data, sealed.displacement)
    assert alike["gear_error", "J3"] > 0.99
    assert alike["target_offset", "smr1"] < 0.2


# ---- stability -----------------------------------------------------------------------------------


A, B, C = ("a", "x"), ("b", "x"), ("c", "x")


def repeats(*names: set[tuple[str, str]], asked: int | None = None) -> Repeats:
    return Repeats(tuple(map(frozenset, names)), asked or len(names))


def test_a_frequency_is_the_share_of_subsamples_that_find_one_of_the_names():
    found = repeats({A}, {A, B}, {B}, {C})
    assert found.frequency({A}) == 0.5
    assert found.frequency({A, B}) == 0.75
    assert found.frequency(set()) == 0.0
    assert np.isnan(repeats({A}, {A}, asked=5).frequency({A}))  # most had too few rows
    assert repeats({A}, {A}, asked=4).frequency({A}) == 1.0


def test_a_name_takes_the_place_of_another_where_it_is_found_without_it():
    assert repeats({A}, {A}, {B}, {B}).instead_of({A}) == [B]
    assert repeats({A}, {A}, {A}, {A}, {A}, {B}).instead_of({A}) == []  # once in six
    assert repeats({A, C}, {A, C}, {B, C}, {B, C}).instead_of({A}) == [B]  # C is there anyhow


def test_every_group_is_left_out_as_often_and_stays_together():
    group = np.repeat(np.arange(30), 4)
    masks = np.array(subsamples(group))
    assert len(masks) == PARTS * ROUNDS
    assert np.all(masks.reshape(ROUNDS, PARTS, -1).sum(axis=1) == PARTS - 1)
    assert np.all(masks.reshape(len(masks), 30, 4) == masks.reshape(len(masks), 30, 4)[..., :1])
    assert np.all(masks.sum(axis=1) == 80)


def test_halves_keep_groups_together_and_every_group_is_in_one_of_a_pair():
    masks = np.array(halves(np.repeat(np.arange(9), 4), 2)).reshape(2, 2, 9, 4)
    assert np.all(masks[:, 0] != masks[:, 1])
    assert np.all(masks == masks[..., :1])
    assert np.all(masks[..., 0].sum(axis=2) == [4, 5])


@dataclass(frozen=True, eq=False)
class Straight:
    """A domain without a robot: y = sum of known regressors, each a law of one parameter."""

    problem: Problem
    regressors: Array

    def spec(self, term: Any) -> Spec | None:
        number = int(term.number)
        none = np.zeros((len(self.regressors), 0))
        free = np.zeros(1, dtype=bool)
        column = self.regressors[:, [number]]
        return Spec(term, term.text, (term.text, "x"), column, none, np.zeros(0, dtype=int), free,
                    1.0, 0, False)  # fmt: skip

    def finer(self, term: Any) -> Sequence[Any]:
        return ()

    def lines(self, noise: Noise, known: Array, found: Sequence[Any]) -> list[tuple[Any, float]]:
        return []

    def is_expected(self, line: Any, found: Sequence[Any]) -> bool:
        return False


@dataclass(frozen=True)
class Law:
    number: int

    @property
    def text(self) -> str:
        return f"law {self.number}"


def straight(rng: np.random.Generator, sizes: dict[int, float], rows: int = 240) -> Library:
    regressors = rng.normal(size=(rows, 30))
    error = rng.normal(size=rows) + sum(
        size * regressors[:, number] for number, size in sizes.items()
    )
    basis = orthonormal(rng.normal(size=(rows, 5)))
    error = error - basis @ (basis.T @ error)
    spread = rng.uniform(0.5, 1.5, rows)
    group = np.arange(rows) // 3
    measured = np.ones(rows, dtype=bool)
    problem = Problem(error, basis, spread / spread.mean(), 1.0, group, measured, 1e-9)
    return Library.of(Straight(problem, regressors), [Law(i) for i in range(30)], ())


def test_a_law_of_any_domain_is_found_again_and_a_faint_one_less_often(rng):
    whole = select(straight(rng, {3: 1.0, 7: 0.25}))
    names = [c.key for c in whole.chosen]
    assert ("law 3", "x") in names
    found = repeated(whole, subsamples(whole.library.rows.group))
    assert len(found.names) == PARTS * ROUNDS
    assert found.frequency({("law 3", "x")}) == 1.0
    assert found.frequency({("law 7", "x")}) < 1.0
    assert found.frequency({("law 1", "x")}) < 0.5


def test_rows_too_few_for_their_geometry_are_not_asked(rng):
    whole = select(straight(rng, {3: 5.0}, rows=27))
    found = repeated(whole, subsamples(whole.library.rows.group))
    assert found.names == ()
    assert np.isnan(found.frequency({("law 3", "x")}))


# ---- library -------------------------------------------------------------------------------------


POSES, MOVED = 400, 163


@pytest.fixture(scope="module")
def shifted(robot: Robot) -> Study:
    """400 poses; the first of two targets sits 0.3 mm elsewhere after some of them."""
    sim = simulate(robot, POSES, 2, seed=1, truth=Truth(compliance=0.0))
    seats = sim.cell.target_positions + np.array([[2e-4, -1e-4, 2e-4], [0.0, 0.0, 0.0]])
    moved = replace(sim.cell, target_positions=seats).predict(sim.data.q)
    moved -= sim.cell.predict(sim.data.q)
    after = (np.arange(POSES) >= MOVED)[:, None, None]
    data = with_history(sim.data.with_y(sim.data.y + np.where(after, moved, 0.0)))
    return studied(robot, data, fit_cell(robot, data, SUM, silent))


def test_motions_that_differ_at_one_pose_are_two(shifted):
    clock = np.sort(shifted.scene.column("clock"))
    terms = [
        (Term("target_shift", target, {"since": float(clock[row])}), 1.0)
        for target in shifted.data.target_names
        for row in (*range(150, 180), POSES - 4)
    ]
    found = Library.empty(ArmLaws(shifted.scene, shifted.rows)).with_terms(terms)
    every = np.concatenate([candidate.main for candidate in found])
    assert len(np.unique(every)) == len(every) == 3 * len(terms)


def test_a_nest_moved_at_the_pose_at_which_it_did(shifted):
    found = select(arm_library(shifted.scene, shifted.rows, ("gear_ripple",))).chosen
    clock = np.sort(shifted.scene.column("clock"))
    assert [c.term.label for c in found] == ["target_shift:smr1"]
    assert found[0].term.choice["since"] == clock[MOVED]


@pytest.mark.parametrize("off", [-30, 1, 17, 30])
def test_a_moment_is_found_from_one_nearby(shifted, off):
    clock = np.sort(shifted.scene.column("clock"))
    term = Term("target_shift", "smr1", {"since": float(clock[MOVED + off])})
    lib = Library.empty(ArmLaws(shifted.scene, shifted.rows))
    near = lib.with_terms([(term, 1.0)])
    table = bench(replace(lib, candidates=tuple(near)), ())
    assert tuned(table, table.added(near[0])).candidate.term.choice["since"] == clock[MOVED]

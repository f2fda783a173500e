"""What a verdict rests on: names found again, structure that matters, what is left to predict."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study_of
from scipy.stats import norm

import minimax_cal as mc
from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.established import loose_among, mostly_loose
from minimax_cal.diagnosing.gap import climbed
from minimax_cal.diagnosing.lack_of_fit import Trace, chance_of, heard
from minimax_cal.diagnosing.remainder import Remainder
from minimax_cal.diagnosing.result import Alternative, Finding
from minimax_cal.diagnosing.verdict import (
    UNASKED,
    UNHELPFUL,
    UNSURE,
    closed_by,
    patched,
    wavers,
    why_loose,
)
from minimax_cal.evidence import limits
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.scene import mask_of
from minimax_cal.modelling.effects.table import Term


def finding(effect: str, place: str, size: float = 100.0, again: float = 1.0) -> Finding:
    none = (0.0,)
    return Finding((Term(effect, place),), ("a",), ("rad",), none, none, size, 1e-9, again=again)


def test_structure_must_be_improbable_and_of_account() -> None:
    rare, small = limits.STRUCTURE / 10.0, 1.0
    assert heard([Trace("a", rare, 500.0), Trace("b", 0.5, 900.0)], 1000.0, 900).name == "a"  # type: ignore[union-attr]
    assert heard([Trace("a", rare, small)], 0.0, 900) is None  # nothing beside the noise
    assert heard([Trace("a", rare, 100.0)], 1e5, 900) is None  # nothing beside what was explained
    asked = [Trace("a", limits.STRUCTURE, 500.0), Trace("b", 0.5, 500.0)]
    assert heard(asked, 0.0, 900) is None  # two were asked
    both = [Trace("a", 0.8 * limits.STRUCTURE, 500.0)] * 2
    assert heard(both, 0.0, 900) is both[0]  # and both say so
    small_too = [both[0], replace(both[0], excess=small)]
    assert heard(small_too, 0.0, 900) is None  # only what matters says anything


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_chances_combine_however_they_depend(alike: float) -> None:
    """Of normal scores that share a part, a level is undercut about as often as it says."""
    rng = np.random.default_rng(5)
    draws = np.sqrt(1.0 - alike) * rng.normal(size=(20000, 20))
    draws += np.sqrt(alike) * rng.normal(size=(20000, 1))
    chances = [chance_of([Trace("", p, 1.0) for p in row]) for row in norm.sf(draws)]
    # 20,000 draws tell a hundredth to 7e-4; the combination is exact for small chances only
    assert 0.005 < np.mean(np.array(chances) < 0.01) < 0.013
    assert chance_of([]) == 1.0
    unasked = [Trace("", 1.0, 0.0), Trace("", float("nan"), 0.0)]  # what cannot be asked says none
    assert chance_of(unasked) == 1.0
    assert_allclose(chance_of([Trace("", 1e-3, 1.0), *unasked]), 1e-3)
    assert_allclose(chance_of([Trace("", 1e-9, 1.0)]), 1e-9, rtol=1e-6)
    doubt, many = Trace("", 1e-6, 1.0, doubts=True), [Trace("", 0.5, 1.0)] * 99
    assert_allclose(chance_of([doubt, *many]), 2e-6, rtol=1e-3)  # names weigh as much as all else


def test_effects_of_which_none_is_established_leave_it_unknown_where_they_tell_much() -> None:
    study = study_of(make(Case("irb2600", "single", (Cause("gear_error", "J1", 300.0),), seed=4)))
    ladder = climbed(study, [[Term("gear_error", "J1", {"turns": 1.0})]])
    assert len(ladder.taken) == 1
    nothing = Remainder(0.0, (), ladder.last.train.rms_mm, None)
    assert wavers(ladder, nothing)
    noise = float(np.sqrt(10.0 * closed_by(ladder)))
    assert not wavers(ladder, replace(nothing, unpredictable_mm=noise))  # a tenth of it is little
    assert not wavers(climbed(study, []), nothing)
    assert_allclose(
        closed_by(ladder),
        ladder.fits[0].train.rms_mm ** 2 - ladder.last.train.rms_mm**2,
        rtol=0.3,  # parts left out tell about as much as the poses of the fit
    )


def test_a_name_that_helps_at_no_poses_left_out_holds_nothing() -> None:
    firm, weak = finding("gear_error", "J3"), finding("encoder_gain", "J2", 50.0, again=0.6)
    chance = replace(finding("backlash", "J1"), p_value=10.0 * limits.CERTAIN)
    every = [firm, weak, chance]
    assert loose_among(every, [firm]) == [weak]
    assert loose_among(every, []) == [firm, weak]  # the ladder refused the first
    rival = Alternative("gear_error", "all", 0.9, 5.0, 1.0, "")
    for other in (finding("gear_error", "all"), finding("backlash", "J3")):
        assert loose_among([firm, other], [firm]) == [other][: other.term.effect == "backlash"]
    bending = replace(finding("link_bending", "L3"), alternatives=(rival,))
    assert loose_among([firm, bending], [firm]) == []  # which is told with it
    assert loose_among([firm, replace(bending, again=0.6)], [firm])  # by itself it changes
    assert not mostly_loose(every, [firm])
    assert mostly_loose(every, [])
    assert mostly_loose([firm, replace(weak, size=300.0)], [firm])
    assert why_loose(every, [weak]) == UNSURE
    assert why_loose(every, [firm, weak]) == UNHELPFUL
    assert why_loose(every, [firm, replace(weak, size=300.0)]) == UNSURE  # most of it changes
    few = [replace(one, again=float("nan")) for one in every]
    assert why_loose(few, loose_among(few, [])) == UNASKED


def test_two_laws_of_one_angle_are_one_that_is_not_known() -> None:
    robot = mc.load_robot("irb2600")
    cell = Cell(robot, np.eye(4), ("smr1",), np.full((1, 3), 0.1))
    scene = cell.scene(still(np.linspace(-1.0, 1.0, 60).reshape(10, 6), ("smr1",), robot))
    whole = {"turns": 1.0, "joints": mask_of(range(6))}

    def unknown(*told: tuple[str, str, float]) -> bool:
        found = [finding(effect, place, size) for effect, place, size in told]
        terms = [replace(f, terms=(replace(f.term, choice=whole),)) for f in found]
        return patched(terms, scene)

    gain = ("encoder_gain", "J2", 100.0)
    assert not unknown()
    assert not unknown(("gear_error", "J2", 100.0))
    assert unknown(("gear_error", "J2", 300.0), gain)
    assert unknown(("gear_error", "all", 300.0), gain)
    assert not unknown(("gear_error", "J2", 300.0), ("encoder_gain", "J3", 100.0))
    assert not unknown(("gear_error", "J2", 300.0), ("axis_wobble", "J2", 100.0))  # no turn
    assert not unknown(("gear_ripple", "J2", 300.0), gain)  # a fine wave is another thing
    assert not unknown(("link_bending", "L2", 900.0), ("gear_error", "J2", 100.0), gain)
    one, two, three = (Term("gear_error", "J2", {"turns": k}) for k in (1.0, 2.0, 3.0))
    orders = finding("gear_error", "J2")
    assert not patched([replace(orders, terms=(one, two))], scene)
    assert patched([replace(orders, terms=(one, two, three))], scene)  # a series for any curve
    entire = (Term("gear_error", "J2", {"orders": 3.0}),)
    assert patched([replace(orders, terms=entire)], scene)
    assert not patched([replace(orders, terms=entire, shown=(three,))], scene)


@pytest.fixture(scope="module")
def two_orders() -> mc.Diagnosis:
    causes = (Cause("gear_error", "J3", 300.0, 0), Cause("gear_error", "J3", 300.0, 1))
    made = make(Case("irb2600", "single", causes, seed=3))
    return mc.diagnose(made.robot, made.data, quick=True)


def test_two_orders_of_one_gear_are_one_effect(two_orders: mc.Diagnosis) -> None:
    assert two_orders.verdict in ("named", "one_of")
    (one,) = two_orders.findings
    assert one.term.key == ("gear_error", "J3")
    assert one.established
    assert set(one.names) == {f"{part} {k}/turn" for part in ("cos", "sin") for k in (1, 2)}


def test_the_file_tells_what_is_established_and_what_remains(two_orders: mc.Diagnosis) -> None:
    said = json.loads(two_orders.json())
    assert [e["established"] for e in said["effects"]] == [True]
    assert set(said["remainder"]) == {"predictable_mm", "where", "unpredictable_mm", "floor_mm"}
    assert said["remainder"]["predictable_mm"] < said["remainder"]["unpredictable_mm"]
    again = mc.Diagnosis.from_dict(said)
    assert isinstance(again.remainder, Remainder)
    assert again.remainder == two_orders.remainder
    assert json.loads(again.json())["effects"][0]["established"] is True
    assert said["effects"][0]["why_tentative"] is None


@pytest.mark.parametrize(
    ("again", "why"),
    [
        (0.8, "not found again without some of the poses"),
        (None, "poses too few to leave any out"),
    ],
)
def test_what_is_tentative_stays_so_in_a_file(
    two_orders: mc.Diagnosis, again: float | None, why: str
) -> None:
    said = json.loads(two_orders.json())
    told = {"established": False, "frequency": again, "why_tentative": why}
    said["effects"][0] |= told
    kept = json.loads(mc.Diagnosis.from_dict(said).json())["effects"][0]
    assert {key: kept[key] for key in told} == told


def test_an_old_file_holds_established_effects(two_orders: mc.Diagnosis) -> None:
    said = json.loads(two_orders.json())
    del said["effects"][0]["established"], said["effects"][0]["frequency"], said["remainder"]
    again = mc.Diagnosis.from_dict(said)
    assert all(found.established for found in again.findings)
    assert again.remainder is None


def test_a_name_that_is_not_found_again_is_tentative() -> None:
    assert finding("backlash", "J1", again=1.0).established
    assert not replace(finding("backlash", "J1"), again=0.8).established

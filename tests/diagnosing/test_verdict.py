"""What a verdict rests on: names found again, structure that matters, what is left to predict."""

import json
from dataclasses import replace

import numpy as np
import pytest

import minimax_cal as mc
from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.causes import with_untested
from minimax_cal.diagnosing.established import loose_among, mostly_loose
from minimax_cal.diagnosing.result import Alternative, Finding
from minimax_cal.diagnosing.verdict import UNASKED, UNHELPFUL, UNSURE, why_loose
from minimax_cal.evidence import limits
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.table import Term


def finding(effect: str, place: str, size: float = 100.0, again: float = 1.0) -> Finding:
    none = (0.0,)
    return Finding((Term(effect, place),), ("a",), ("rad",), none, none, size, 1e-9, again=again)


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


@pytest.fixture(scope="module")
def two_orders() -> mc.Diagnosis:
    causes = (Cause("gear_error", "J3", 300.0, 0), Cause("gear_error", "J3", 300.0, 1))
    made = make(Case("irb2600", "single", causes, seed=3))
    return mc.diagnose(made.robot, made.data, quick=True)


def test_two_orders_of_one_gear_are_one_effect(two_orders: mc.Diagnosis) -> None:
    assert two_orders.verdict in ("named", "one_of")
    (one,) = two_orders.effects
    assert one.term.key == ("gear_error", "J3")
    assert one.established
    assert set(one.names) == {f"{part} {k}/turn" for part in ("cos", "sin") for k in (1, 2)}


def test_the_file_tells_what_is_established_and_what_remains(two_orders: mc.Diagnosis) -> None:
    said = json.loads(two_orders.json())
    assert [e["established"] for e in said["effects"]] == [True]
    left = said["remaining"]
    assert set(left) == {"depends", "unexplained_mm", "noise_mm", "noise_from"}
    parts = [left["noise_mm"], left["unexplained_mm"], *(d["rms_mm"] for d in left["depends"][:1])]
    last = two_orders.ladder[-1].trusted.rms_mm
    assert np.hypot.reduce(parts) == pytest.approx(max(last, left["noise_mm"]))  # it closes
    assert set(said["remainder"]) == {"predictable_mm", "where", "unpredictable_mm", "floor_mm"}
    again = mc.Diagnosis.from_dict(said)
    assert again.remaining == two_orders.remaining
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
    del said["effects"][0]["established"], said["effects"][0]["frequency"], said["remaining"]
    again = mc.Diagnosis.from_dict(said)
    assert all(found.established for found in again.effects)
    assert again.remaining is None


def test_what_could_not_be_tested_stands_among_the_alternatives_of_its_relatives() -> None:
    """Without masses a joint that yields to its own load may yield to its neighbour's."""
    robot = mc.load_robot("irb2600")
    bare = Cell(robot, np.eye(4), ("smr1",), np.full((1, 3), 0.1))
    scene = bare.scene(still(np.linspace(-1.0, 1.0, 60).reshape(10, 6), ("smr1",), robot))
    assert not scene.known_masses
    (rival,) = with_untested(finding("joint_compliance", "J2"), scene, ()).alternatives
    assert (rival.effect, rival.place) == ("cross_compliance", "J2")
    assert "mass_kg" in rival.separate_with
    assert not with_untested(finding("joint_compliance", "J2"), scene, (rival.effect,)).alternatives
    assert not with_untested(finding("gear_error", "J2"), scene, ()).alternatives
    heavy = replace(robot, mass=np.full(6, 5.0), com=np.zeros((6, 3)))
    told = replace(bare, robot=heavy).scene(scene.data)
    assert not with_untested(finding("joint_compliance", "J2"), told, ()).alternatives

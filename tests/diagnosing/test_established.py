from dataclasses import replace

import numpy as np
import pytest
from problems_fit import study_of

import minimax_cal as mc
from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.established import (
    dwarfs,
    is_found,
    is_rival,
    is_uncontested,
    laws_there,
    share,
    shows,
)
from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.selection import Choice, select
from minimax_cal.modelling.dictionary import arm_library
from minimax_cal.modelling.effects.table import Term


def found(effect: str, place: str, size: float) -> Finding:
    return Finding((Term(effect, place),), ("x",), ("1",), (1.0,), (0.1,), size, 1e-9)


def test_a_small_effect_of_the_same_course_is_dwarfed() -> None:
    warm = found("thermal_growth", "all", 4000.0)
    assert dwarfs(warm, found("frame_drift", "frame", 100.0))
    assert not dwarfs(warm, found("frame_drift", "frame", 400.0))
    assert not dwarfs(warm, found("gear_error", "J2", 100.0))
    assert dwarfs(found("settling", "all", 4000.0), found("backlash", "J1", 100.0))


def test_what_is_dwarfed_is_not_established() -> None:
    drift = found("frame_drift", "frame", 100.0)
    assert drift.established
    assert not replace(drift, dwarfed=True).established
    assert not replace(drift, again=0.8).established


def test_a_part_that_cannot_show_an_effect_is_no_test_of_it() -> None:
    assert share([True, True, True]) == 1.0
    assert share([True, True, True, False]) == 0.75
    assert share([True, True]) == 0.0  # three parts at least must ask
    assert share([]) == 0.0


def test_poses_too_few_to_ask_leave_an_effect_tentative_and_in_the_model() -> None:
    """Twenty poses of one target: four fifths of them tell the geometry and little more."""
    made = make(
        Case("irb2600", "single", (Cause("joint_compliance", "J2", 2e4),), seed=3, poses=20)
    )
    data = made.data.keep(np.arange(len(made.data.target_names)) == 0).take(np.arange(20))
    columns = {name: column for name, column in data.columns.items() if name != "split"}
    told = mc.diagnose(made.robot, replace(data, columns=columns), quick=True)
    (one,) = told.findings
    assert one.term.key == ("joint_compliance", "J2")
    assert np.isnan(one.again)
    assert not one.established
    assert told.to_dict()["effects"][0]["frequency"] is None
    geometric, last = told.ladder[1].holdout, told.ladder[-1].holdout
    assert last.rms_mm < 0.2 * geometric.rms_mm


@pytest.fixture(scope="module")
def geared() -> tuple[Study, Library]:
    study = study_of(make(Case("irb2600", "single", (Cause("gear_error", "J1", 300.0),), seed=4)))
    return study, arm_library(study.scene, study.rows)


def named(choice: Choice, *key: str) -> Finding:
    one = next(fit for fit in choice.fits if fit.candidate.key == key)
    size, _ = choice.benches[choice.fits.index(one)].likeness(one, one.candidate)
    return replace(found(*key, size), terms=(one.candidate.term,))


def test_an_effect_is_shown_by_poses_that_turn_its_joint(geared: tuple[Study, Library]) -> None:
    """And not by a fifth of the sweep, in which one wave a turn is what geometry does."""
    study, lib = geared
    whole = select(lib)
    effect = named(whole, "gear_error", "J1")
    q = study.data.q[:, 0]
    order = np.argsort(np.argsort(q))
    some = select(whole.part(study.rows.at(order % 5 != 0)))
    assert shows(effect, some, whole)
    assert is_found(effect, some, whole)
    few = select(whole.part(study.rows.at(np.abs(order - len(q) / 2) < 0.1 * len(q))))
    assert not shows(effect, few, whole)


def test_an_effect_is_found_where_its_rival_is_named(geared: tuple[Study, Library]) -> None:
    _, lib = geared
    whole = select(lib)
    effect = replace(named(whole, "gear_error", "J1"), alternatives=())
    candidates = tuple(c for c in lib.candidates if c.term.effect != "gear_error")
    other = select(replace(lib, candidates=candidates))
    assert other.chosen
    # without gears to choose from it has no such rival; beside them, what it names instead has
    assert not is_rival(effect, other)
    assert is_rival(effect, replace(other, library=lib))
    assert is_found(effect, replace(other, library=lib), whole)
    assert not is_found(effect, other, whole)


def test_a_part_that_names_nothing_else_is_asked_for_the_effect_by_itself() -> None:
    """To come first of a whole library takes more power than to be there."""
    study = study_of(make(Case("irb2600", "single", (Cause("gear_error", "J1", 60.0),), seed=4)))
    lib = arm_library(study.scene, study.rows)
    whole = select(lib)
    effect = replace(named(whole, "gear_error", "J1"), alternatives=())
    rest = whole.part(study.rows.at(np.arange(study.data.poses) % 5 != 0))
    silent = select(rest, level=1e-15)
    assert not silent.chosen
    assert not is_found(effect, silent, whole)
    assert shows(effect, silent, whole)
    assert is_uncontested(effect, silent, whole)
    assert not is_rival(effect, silent)
    (fit,) = whole.fits
    twice = replace(whole)
    object.__setattr__(twice, "fits", (replace(fit, value=2.0 * fit.value),))
    assert not is_uncontested(effect, silent, twice)  # its size is not what all poses tell
    candidates = tuple(c for c in lib.candidates if c.term.effect != "gear_error")
    other = select(replace(rest, candidates=candidates))
    assert other.chosen
    assert not is_uncontested(effect, replace(other, library=rest), whole)  # another name is there
    rng = np.random.default_rng(0)
    flipped = study.rows.error * rng.choice([-1.0, 1.0], len(study.rows.error))
    bare = arm_library(study.scene, replace(study.rows, error=flipped))
    nothing = select(bare, level=1e-15)
    assert not nothing.chosen
    assert not is_uncontested(effect, nothing, whole)  # points tell nothing of it


def test_an_effect_that_shares_its_joint_with_another_variant_need_not_agree(
    geared: tuple[Study, Library],
) -> None:
    """What of a joint's wave another name holds in a part is not in its own parameters."""
    _, lib = geared
    whole = select(lib)
    effect = replace(named(whole, "gear_error", "J1"), alternatives=())
    far = replace(whole)
    object.__setattr__(far, "estimates", tuple((3.0 * v, s) for v, s in whole.estimates))
    assert not is_found(effect, far, whole)
    (close,) = lib.with_terms([(Term("gear_error", "J1", {"turns": 2.1}), 1.0)])
    tuned = replace(far, found=(replace(far.found[0], candidate=close),))
    assert laws_there(effect, tuned) == laws_there(effect, whole)  # whatever the number
    (wide,) = lib.with_terms([(Term("gear_error", "all", {"turns": 1.0, "joints": 63.0}), 1.0)])
    more = replace(far, found=(*far.found, replace(far.found[0], candidate=wide)))
    object.__setattr__(more, "estimates", (*far.estimates, (np.ones(12), np.ones(12))))
    assert is_found(effect, more, whole)

"""Every law and variant of the effects' table, from the fit to what leaves the house.

An effect that is fitted has to come out of every format of `export`, of `compensate` and of
`report`; what cannot be made says why in one line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from dynamics.motions import three_joints
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.compensation.exporters.export_formats import DOCUMENTED_EXPORT_FORMATS
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.table import EFFECTS, FREE_CHOICE_KEYS, Term
from minimax_cal.solvers.status import Status

POSES = 40
NOT_FOUND = {  # variants of laws that these data suggest none of
    "gear_ripple": [{"turns": 17.0}],
    "session_jump": [{"since": 0.5}],
}
NEVER_MADE = {"ur-yaml": "six turning joints"}  # of an arm of three joints


@pytest.fixture(scope="module")
def measured() -> tuple[Measurements, Measurements]:
    """An arm's points with all that effects need; the same in two sessions."""
    rng, robot = np.random.default_rng(0), three_joints()
    data = replace(mc.simulate(robot, POSES, 3, 1).data, simulated=False)
    columns: dict[str, Array] = {**data.columns, "t_s": 30.0 * np.arange(POSES)}
    columns["temperature"] = 20.0 + 5.0 * (1.0 - np.exp(-np.arange(POSES) / 15.0))
    for j in range(robot.joints):
        columns[f"approach{j + 1}"] = rng.choice([-1.0, 1.0], POSES)
    session = np.where(np.arange(POSES) < POSES // 2, "a", "b")
    return replace(data, columns=columns), replace(data, columns={**columns, "session": session})


def variants_of(name: str, data: Measurements) -> dict[object, str]:
    """One text, as `--effects` takes it, of each variant of a law, at one place and at all."""
    effect, found = EFFECTS[name], dict[object, str]()
    cell = mc.calibrate(three_joints(), data, "sum").cell
    scene = cell.pose_arm(add_history_columns(data))
    assert not effect.needs(scene)
    places = tuple(effect.places(scene))
    for place in dict.fromkeys((places[0], places[-1])):
        choices = list(effect.choices(scene, place))
        choices += [one for choice in choices for one in effect.entire([choice], ())]
        choices += effect.entire(choices[:2], ()) if place != "all" else ()
        for choice in choices or NOT_FOUND[name]:
            shape = {
                k: v if k not in FREE_CHOICE_KEYS else bool(np.isinf(v)) for k, v in choice.items()
            }
            found.setdefault((place == "all", *shape.items()), Term(name, place, choice).text)
    return found


def one_line(make: Callable[[], object]) -> str:
    """Why something cannot be made, empty where it can."""
    said = ""
    try:
        make()
    except mc.CalibrationError as error:
        said = str(error)
    assert "\n" not in said
    return said


@pytest.mark.parametrize("name", EFFECTS)
def test_what_is_fitted_leaves_in_every_form(name, measured, tmp_path):
    """The file of geometry alone stands where the fit without the effect says."""
    mujoco = pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (9, 3))
    cases = [(text, measured[0]) for text in variants_of(name, measured[0]).values()]
    cases += [(text, measured[1]) for text in variants_of(name, measured[1]).values()
              if "session=" in text]  # fmt: skip
    assert cases
    for text, data in cases:
        fit = mc.calibrate(three_joints(), data, "sum", effects=text)
        assert fit.status is not Status.FAILED, text
        assert name in {term.effect for term in fit.cell.effects.terms}
        for to in DOCUMENTED_EXPORT_FORMATS:
            path = tmp_path / f"arm.{to}.xml"
            why = one_line(lambda: mc.export(fit, to, path, keep_anyway=True, notify=id))  # noqa: B023
            assert (NEVER_MADE[to] in why) if to in NEVER_MADE else not why, (text, to, why)
        alone = mc.deliver(fit, "urdf").cell.robot
        urdf = (tmp_path / "arm.urdf.xml").rename(tmp_path / "arm.urdf")
        assert_allclose(mc.load_robot(urdf).pose(q), alone.pose(q), rtol=0, atol=1e-9)
        assert mujoco.MjModel.from_xml_path(str(tmp_path / "arm.mjcf.xml")).njnt >= 3
        assert np.isfinite(mc.compensate(fit, q, keep_anyway=True).q).all(), text
        page = mc.report(fit, tmp_path / "page.html", tolerance="rms 0.2", notify=id).read_text()
        assert [row for row in ("corrected targets", "urdf file", "mjcf file") if row in page], text


def test_a_file_that_cannot_be_made_is_a_row_that_says_why(measured, tmp_path, says):
    fit = mc.calibrate(three_joints(), measured[0], "sum", effects="encoder_gain:all")
    fit.save(tmp_path / "fit.json")
    asked = ("report", tmp_path / "fit.json", "--tolerance", "rms 5", "--deliver", "ur-yaml")
    out = says(*asked, "--deliver", "urdf", "-o", tmp_path / "page.html").out
    assert out.startswith("not stated for ur-yaml file")
    assert "ur-yaml cannot be made: the format is for arms with six turning joints" in out
    assert "urdf file" in (tmp_path / "page.html").read_text()
    assert run("export", tmp_path / "fit.json", "--to", "ur-yaml", "-o", tmp_path / "a.yaml") == 2


def test_a_deliverable_that_fails_does_not_cost_the_report(measured, tmp_path, monkeypatch):
    """Whatever ends its fit: the others are judged."""
    from minimax_cal.compensation import deliverable

    fit = mc.calibrate(three_joints(), measured[0], "sum", effects="encoder_gain:all")
    whole = deliverable.deliver

    def broken(given: object, to: str, **more: object) -> object:
        if to == "mjcf":
            raise np.linalg.LinAlgError("SVD did not converge")
        return whole(given, to, **more)

    monkeypatch.setattr(deliverable, "deliver", broken)
    page = Path(mc.report(fit, tmp_path / "page.html", tolerance="rms 5", notify=id)).read_text()
    assert "mjcf cannot be made: SVD did not converge" in page
    assert "passed" in page

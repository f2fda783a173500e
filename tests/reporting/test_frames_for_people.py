"""Base and tool of a calibrated arm, and the corrections, against the truth and the parameters."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from test_report import Seen

import minimax_cal as mc
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.instruments import flange_poses
from minimax_cal.modelling.cell_frames import build_cell_frame_tables, build_cell_frames
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.transforms import build_transform
from minimax_cal.validation.bootstrap import bootstrap

BASE = ("base", "base_nominal", "base_correction")
TOOL = ("tool", "tool_nominal", "tool_correction")
KEYS = {"xyz_mm", "abc_deg", "quaternion_wxyz", "rotation_vector_rad"}


def test_the_base_is_where_it_stands(fit):
    frames = fit.to_dict()["frames"]
    assert list(frames) == [*BASE, *TOOL]
    assert all(set(frame) == KEYS for frame in frames.values())
    base = frames["base"]
    assert_allclose(base["xyz_mm"], 1e3 * fit.cell.base[:3, 3], rtol=1e-15)
    turn = Rotation.from_euler("ZYX", base["abc_deg"], degrees=True).as_matrix()
    assert_allclose(turn, fit.cell.base[:3, :3], rtol=0, atol=1e-14)
    # the very case in which the first row of the table was taken for the place of the base
    assert abs(fit.parameters["base_x"].value) != pytest.approx(1e-3 * abs(base["xyz_mm"][0]))


def test_corrections_are_the_changes_of_the_parameters(fit):
    correction = fit.frames["base_correction"]
    one = {p.name: p for p in fit.parameters}
    moved = [1e3 * (one[f"base_{a}"].value - one[f"base_{a}"].nominal) for a in "xyz"]
    turned = [one[f"base_r{a}"].value - one[f"base_r{a}"].nominal for a in "xyz"]
    assert_allclose(correction.xyz_mm, moved, rtol=0, atol=1e-9)
    assert_allclose(correction.rotation_vector_rad, turned, rtol=0, atol=1e-12)
    for name in ("base", "tool"):
        drawn, found = fit.frames[f"{name}_nominal"].pose, fit.frames[name].pose
        assert_allclose(drawn @ fit.frames[f"{name}_correction"].pose, found, rtol=0, atol=1e-12)


def test_the_tool_is_the_reflectors_as_one_body(fit):
    known = (
        np.array([0.01, -0.02, 0.03]),
        Rotation.from_euler("ZYX", [3.0, -2.0, 1.0], degrees=True),
    )
    spots = fit.nominal.target_positions
    middle = spots.mean(axis=0)
    there = (spots - middle) @ known[1].as_matrix().T + middle + known[0]
    frames = build_cell_frames(replace(fit.cell, target_positions=there), fit.nominal)
    assert_allclose(frames["tool_correction"].xyz_mm, 1e3 * known[0], rtol=0, atol=1e-9)
    assert_allclose(frames["tool_correction"].abc_deg, [3.0, -2.0, 1.0], rtol=0, atol=1e-9)
    assert_allclose(frames["tool"].xyz_mm, 1e3 * there.mean(axis=0), rtol=1e-12)
    assert frames["tool_nominal"].abc_deg == (0.0, 0.0, 0.0)


def test_reflectors_that_tell_no_turn_make_no_tool(fit):
    line = np.arange(3.0)[:, None] * [0.05, 0.02, 0.0]
    for spots in (line, line[:2]):
        cells = [replace(cell, target_positions=spots) for cell in (fit.cell, fit.nominal)]
        assert list(build_cell_frames(*cells)) == list(BASE)
    assert list(build_cell_frames(fit.cell, None)) == ["base"]


def test_a_further_session_has_its_instrument(fit):
    away = build_transform(np.eye(3), np.array([0.5, 0.0, 0.0]))
    sessions = replace(fit.cell.sessions, frames={"monday": np.eye(4), "tuesday": away})
    frames = build_cell_frames(replace(fit.cell, sessions=sessions), fit.nominal)
    assert frames["session tuesday"].xyz_mm == (500.0, 0.0, 0.0)
    assert "instrument of session tuesday" in [
        row[0] for row in build_cell_frame_tables(frames)[0].rows
    ]


def test_people_read_a_distance_that_is_the_norm_in_json(tmp_path, noisy, says):
    mc.write_measurements(tmp_path / "poses.csv", noisy.data)
    out, page = tmp_path / "fit.json", tmp_path / "report.html"
    told = says("calibrate irb2600", tmp_path / "poses.csv", "-o", out, "--details").out
    frames = json.loads(out.read_text())["frames"]
    away = np.linalg.norm(frames["base"]["xyz_mm"])
    assert f"the base is {away:.3f} mm from the instrument" in " ".join(told.split())
    assert run("report", out, "-o", page, "-q", "--appendix") == 0
    seen = Seen(page.read_text())
    rows = {row[0]: row[1:] for title, found in seen.tables.items()
            if title.startswith(f"frames: the base is {away:.3f} mm") for row in found}  # fmt: skip
    assert rows["base"][:3] == [f"{v:.3f}" for v in frames["base"]["xyz_mm"]]
    assert rows["base"][3:] == [f"{v:.4f}" for v in frames["base"]["abc_deg"]]
    assert "base correction" in rows
    for text in (told, page.read_text()):
        assert "base_x (correction)" in text
        assert "Rz(A) Ry(B) Rx(C)" in text
        assert f"{frames['base']['quaternion_wxyz'][1]:.6f}" in text
        assert f"{frames['base']['rotation_vector_rad'][1]:.6f}" in text


def test_a_correction_is_never_told_as_a_value(fit):
    rows = {row[0]: row[1:] for row in fit.parameter_table().rows}
    assert "base_x" not in rows
    nominal, calibrated, _, change, _, unit, _ = rows["base_x (correction)"]
    assert np.isnan([nominal, calibrated]).all()
    assert (change, unit) == (1e3 * (fit.parameters["base_x"].value
                                     - fit.parameters["base_x"].nominal), "mm")  # fmt: skip
    written = {p["name"]: p for p in fit.to_dict()["parameters"]}
    assert written["base_x"]["correction"] == pytest.approx(change, rel=1e-12)
    assert "base of the drawn arm" in written["base_x"]["corrects"]
    assert "corrects" not in written["a1"]
    drawn = {row[0]: row for row in bootstrap(fit, 40).table().rows}
    low, high = drawn["base_x (correction)"][4:]
    assert low < change < high


def test_angles_are_in_degrees_and_their_changes_in_milliradians(fit):
    rows = {row[0]: row[1:] for row in fit.parameter_table().rows}
    one = fit.parameters["alpha2"]
    assert rows["alpha2"][:6] == (
        np.degrees(one.nominal), np.degrees(one.value), "deg",
        1e3 * (one.value - one.nominal), 1e3 * one.sigma, "mrad",
    )  # fmt: skip
    assert rows["a2"][2:6:3] == ("mm", "mm")


def test_whole_poses_have_base_and_tool(robot):
    made = simulate(robot, 60, 3, seed=2)
    base, tool = (
        made.cell.base,
        build_transform(
            Rotation.from_euler("ZYX", [20.0, 5.0, -8.0], degrees=True).as_matrix(),
            np.array([0.03, 0.01, 0.2]),
        ),
    )
    q = made.data.q
    found = relative(robot, flange_poses(q, base @ made.cell.robot.pose(q) @ tool))
    assert list(found.frames) == [*BASE, *TOOL]
    drawn, correction = (found.frames[f"tool{end}"].pose for end in ("_nominal", "_correction"))
    assert_allclose(drawn @ correction, found.frames["tool"].pose, rtol=0, atol=1e-9)
    assert found.frames["tool"].abc_deg[0] == pytest.approx(20.0, abs=0.3)
    assert "tool correction" in found.summary(200)
    again = RelativeCalibration.from_dict(found.to_dict())
    assert again.to_dict()["frames"] == found.to_dict()["frames"]


def test_frames_with_effects_stand_beside_those_of_geometry(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "sum", effects="joint_compliance:all")
    frames = fit.to_dict()["frames"]
    plain, whole = (1e3 * cell.base[:3, 3] for cell in (fit.geometric, fit.cell))
    assert_allclose(frames["base"]["xyz_mm"], plain, rtol=1e-15)
    assert frames["base"]["xyz_mm"] == pytest.approx(fit.to_dict()["base"]["translation_mm"])
    assert_allclose(frames["base_with_effects"]["xyz_mm"], whole, rtol=1e-15)
    assert np.abs(plain - whole).max() > 1e-3
    moved = frames["base_correction_with_effects"]["xyz_mm"][0]
    one = fit.parameters["base_x"]  # of the table, which is of the fit with effects
    assert moved == pytest.approx(1e3 * (one.value - one.nominal), abs=1e-9)
    assert "base correction, with effects" in fit.summary(200)
    shown = fit.first_tables()[1]  # goes with the accuracy and the parameters beside it
    assert "with effects" in shown.title
    assert_allclose(shown.rows[0][1:4], whole, rtol=1e-9)


def test_links_of_a_robot_are_in_degrees(answered, says):
    told = says("robots irb2600").out
    assert "alpha deg" in told
    assert "-90.000" in told
    content = answered("robots irb2600")
    assert content["joints"][0]["alpha"] == pytest.approx(mc.load_robot("irb2600").mdh[0, 3])

"""UR's own files: nearly parallel axes, calibration.conf, ur_description's kinematics YAML."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minimax_cal import RobotError, load_robot
from minimax_cal.robots.gravity_torques import link_masses_and_centres
from minimax_cal.robots.parallel_axes import move_frames_along_parallel_axes

# deviations as a controller has them: common normals of nearly parallel axes, 100 m away
DELTAS = {
    "delta_theta": [2e-5, 0.97, -1.857, 0.887, 5.6e-5, -7.4e-5],
    "delta_a": [4e-4, 0.184, 0.145, -6.4e-5, 7.8e-6, 0.0],
    "delta_d": [4e-5, 278.2, -183.7, -94.5, 3e-4, 1.2e-4],
    "delta_alpha": [-2.7e-4, 1.26e-3, -3.22e-3, 6.5e-4, -5.9e-4, 0.0],
}
Q = np.random.default_rng(2).uniform(-3.0, 3.0, (40, 6))


def controller_rows():
    rows = load_robot("ur5").mdh.copy()
    for column, key in enumerate(("delta_a", "delta_d", "delta_theta", "delta_alpha")):
        rows[:, column] += DELTAS[key]
    return rows


def textbook_poses(rows, q):
    """Standard DH, multiplied out by hand: independent of the package's kernels."""
    out = np.tile(np.eye(4), (len(q), 1, 1))
    for (a, d, theta, alpha, _), value in zip(rows, q.T, strict=True):
        c, s, ca, sa = np.cos(theta + value), np.sin(theta + value), np.cos(alpha), np.sin(alpha)
        link = np.zeros((len(q), 4, 4))
        link[:, 0] = np.stack([c, -s * ca, s * sa, a * c], axis=1)
        link[:, 1] = np.stack([s, c * ca, -c * sa, a * s], axis=1)
        link[:, 2], link[:, 3, 3] = [0.0, sa, ca, d], 1.0
        out = out @ link
    return out


def assert_is_made_ur5(robot):
    drawn = load_robot("ur5")
    assert_allclose(robot.mdh[:, :2], drawn.mdh[:, :2], rtol=0, atol=0.01)
    assert robot.reach() == pytest.approx(drawn.reach(), rel=0.01)
    for ours, theirs in zip(*map(link_masses_and_centres, (robot, drawn)), strict=True):
        assert_allclose(ours, theirs, rtol=0.01, atol=0.005)


def test_frames_move_and_poses_stay():
    rows = controller_rows()
    moved = move_frames_along_parallel_axes(rows).mdh
    # 100 m of doubles resolve 1e-14 m each; 1e-12 m is 1e-9 mm
    arm = load_robot("ur5").with_mdh(moved)
    assert_allclose(arm.pose(Q), textbook_poses(rows, Q), rtol=0, atol=2e-12)


def test_calibration_conf(tmp_path):
    path = tmp_path / "calibration.conf"
    lines = [f"{key} = [ {', '.join(map(repr, row))} ]" for key, row in DELTAS.items()]
    path.write_text("\n".join(["[mounting]", *lines, "joint_checksum = [ 1, 2 ]"]) + "\n")
    with pytest.raises(RobotError, match="ur5, ur5e are possible"):  # of the same lengths
        load_robot(path)
    robot = load_robot(f"{path}#ur5")
    assert "UR5" in robot.name
    assert_allclose(robot.pose(Q), textbook_poses(controller_rows(), Q), atol=2e-12)
    assert_is_made_ur5(robot)
    path.write_text("[mounting]\ndelta_a = [1, 2]\n")
    with pytest.raises(RobotError, match="delta_a"):
        load_robot(path)


def test_link_table_of_the_controller(tmp_path):
    path = tmp_path / "long.csv"
    rows = controller_rows()[:, [0, 3, 1, 2]]
    np.savetxt(
        path,
        rows,
        "%.17g",
        ",",
        header="# convention: standard\na_m,alpha_rad,d_m,theta_rad",
        comments="",
    )
    robot = load_robot(path)
    assert_allclose(robot.pose(Q), textbook_poses(controller_rows(), Q), atol=2e-12)
    assert_is_made_ur5(robot)


def test_other_arms_keep_their_links():
    for name in ("ur5", "ur10e", "scara_600", "irb120", "fanuc_r2000ic_165f"):
        rows = load_robot(name).mdh
        assert_allclose(move_frames_along_parallel_axes(rows).mdh, rows, rtol=0, atol=0)


def test_kinematics_yaml(tmp_path):
    from minimax_cal.compensation.exporters.export_job import joint_origins
    from minimax_cal.robots.transforms import pose_to_rpy
    from minimax_cal.robots.ur_files import UR_LINK_NAMES

    drawn = load_robot("ur5")
    text = "kinematics:\n"
    for name, pose in zip(UR_LINK_NAMES, joint_origins(drawn), strict=False):
        numbers = zip(
            ("x", "y", "z", "roll", "pitch", "yaw"), (*pose[:3, 3], *pose_to_rpy(pose)), strict=True
        )
        text += f"  {name}: {{{', '.join(f'{k}: {float(v)!r}' for k, v in numbers)}}}\n"
    path = tmp_path / "ur.yaml"
    path.write_text(text + "  hash: calib_1\n")
    robot = load_robot(path)
    # the same up to constant frames before the base and behind the flange
    ours, theirs = robot.pose(Q), drawn.pose(Q)
    relative = np.linalg.inv(ours[0]) @ ours, np.linalg.inv(theirs[0]) @ theirs
    distance = [np.linalg.norm((pose - np.eye(4))[:, :3, :3], axis=(1, 2)) for pose in relative]
    assert_allclose(*distance, atol=1e-12)

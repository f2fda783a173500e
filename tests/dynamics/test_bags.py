"""Joint states of ROS bags, as a folder, an SQLite file and MCAP."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dynamics.motions import fourier
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.dynamics.logs import are_logs, read_runs

NAMES = ("lift", "turn", "gripper")
ROWS = 400


def bag(folder: Path, plugin: str, *, effort: bool = True, topics: int = 1) -> tuple[Path, Any]:
    """A recorded bag, its joint values and torques."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs the extra logs")
    typesys = pytest.importorskip("rosbags.typesys")
    types = typesys.get_typestore(typesys.Stores.LATEST)
    kind = types.types["sensor_msgs/msg/JointState"]
    header, stamp = types.types["std_msgs/msg/Header"], types.types["builtin_interfaces/msg/Time"]
    t = 0.01 * np.arange(ROWS)
    rng = np.random.default_rng(2)
    q, qd, _ = fourier(rng, t, 3, rate=0.3)
    tau = 5.0 * np.cos(q) + 0.1 * rng.normal(size=q.shape)
    path = folder / "bag"
    storage = rosbag2.StoragePlugin[plugin]
    with rosbag2.Writer(path, version=9, storage_plugin=storage) as writer:
        for topic in range(topics):
            at = writer.add_connection(
                f"/arm{topic}/joint_states", kind.__msgtype__, typestore=types
            )
            for i in range(ROWS):
                when = stamp(1700000000 + int(t[i]), round(1e9 * (t[i] % 1.0)))
                force = tau[i] if effort else np.empty(0)
                said = kind(header(when, ""), list(NAMES), q[i], qd[i], force)
                ns = 1700000000_000000000 + round(1e9 * t[i])
                writer.write(at, ns, types.serialize_cdr(said, kind.__msgtype__))
    return path, (t, q, tau)


@pytest.mark.parametrize(("plugin", "ending"), [("SQLITE3", ""), ("SQLITE3", "*.db3"),
                                                ("MCAP", ""), ("MCAP", "*.mcap")])  # fmt: skip
def test_a_bag_is_a_run(tmp_path: Path, plugin: str, ending: str) -> None:
    path, (t, q, tau) = bag(tmp_path, plugin)
    path = next(path.glob(ending)) if ending else path
    assert are_logs([path])
    (run,) = read_runs(path, ("turn", "lift"))
    (notice,) = run.notices
    assert "gripper" in notice
    assert_allclose(run.time, t, atol=1e-6)
    assert_allclose(run.q, q[:, [1, 0]], atol=1e-12)
    assert_allclose(run.torque, tau[:, [1, 0]], atol=1e-12)


def test_bags_that_hold_nothing_of_use(tmp_path: Path) -> None:
    path, _ = bag(tmp_path, "MCAP", effort=False)
    with pytest.raises(mc.DataError, match=r"holds no effort in /arm0/joint_states; record"):
        read_runs(path)
    file = next(path.glob("*.mcap"))
    (tmp_path / "cut.mcap").write_bytes(file.read_bytes()[:3000])
    with pytest.raises(mc.DataError, match=r"cut.mcap: cannot be read as a bag") as caught:
        read_runs(tmp_path / "cut.mcap")
    assert "\n" not in str(caught.value)
    with pytest.raises(mc.DataError, match=r"gone.mcap: cannot be read \(No such file"):
        read_runs(tmp_path / "gone.mcap")


def test_two_arms_in_a_bag(tmp_path: Path) -> None:
    path, _ = bag(tmp_path, "MCAP", topics=2)
    with pytest.raises(mc.DataError, match=r"efforts in /arm0/joint_states and /arm1/joint_states"):
        read_runs(path)


def test_without_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mcap").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(mc.OptionError, match=r"reading a bag needs rosbags.*\[logs\]"):
        read_runs(tmp_path / "a.mcap")

"""The command `import` on logs: what was understood, and CSV in the house's columns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from dynamics.motions import fourier
from numpy.testing import assert_allclose

import minimax_cal as mc


def rtde(path: Path, seed: int) -> Path:
    """A log as UR's recorder writes it: cells that spaces separate."""
    rng = np.random.default_rng(seed)
    t = 0.008 * np.arange(500)
    q, qd, _ = fourier(rng, t, 6, rate=0.3)
    current = np.cos(q) + 0.02 * rng.normal(size=q.shape)
    stems = ("actual_q", "actual_qd", "actual_current")
    header = ["timestamp", *(f"{stem}_{j}" for stem in stems for j in range(6))]
    table = np.column_stack([100.0 + t, q, qd, current])
    np.savetxt(path, table, fmt="%.8g", header=" ".join(header), comments="")
    return path


def test_logs_become_the_houses_columns(tmp_path, capsys):
    files = [rtde(tmp_path / "a.csv", 1), rtde(tmp_path / "b.csv", 2)]
    assert run("import", *files, "-o", tmp_path / "out.csv") == 0
    said = capsys.readouterr()
    assert "2 runs, 8.0 s, 6 joints" in said.out
    assert "UR RTDE" in said.out
    header = (tmp_path / "out.csv").read_text().partition("\n")[0].split(",")
    assert header[:3] == ["run", "t_s", "q1_rad"]
    assert header[-1] == "i6_A"
    for one, again in zip(mc.read_runs(files), mc.read_runs(tmp_path / "out.csv"), strict=True):
        assert again.name == f"out:{one.name}"
        assert_allclose(again.torque, one.torque, atol=1e-8)
        assert_allclose(again.q, one.q, atol=1e-8)


def test_logs_in_json(tmp_path, capsys):
    path = rtde(tmp_path / "a.csv", 1)
    assert run("import", path, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["joints"], told["unit"], told["notices"]) == (6, "A", [])
    assert told["runs"][0]["rows"] == 500
    assert told["runs"][0]["step_s"] == pytest.approx(0.008)
    assert told["runs"][0]["columns"][-1] == "actual_current_5"


def test_what_is_wrong_ends_with_2(tmp_path, capsys):
    path = rtde(tmp_path / "a.csv", 1)
    assert run("import", path, "--leave-out", "3") == 2
    assert "--leave-out is about measured points" in capsys.readouterr().err
    assert run("import", path, "--mend", "shift=2") == 2
    assert "--mend is about measured points" in capsys.readouterr().err
    rows = ["t_s,q1_deg,q2_deg", *(f"{0.01 * i},{i},{2 * i}" for i in range(300))]
    (tmp_path / "plan.csv").write_text("\n".join(rows))
    assert run("import", tmp_path / "plan.csv") == 2
    assert "no column of torque or current; drive this motion" in capsys.readouterr().err

"""The report of a motion diagnosis says what the file says, of every joint."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from dynamics.motions import simulated, three_joints

import minimax_cal as mc
from minimax_cal.dynamics.regressor import Motion
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.reporting.html import Figure, Wording
from minimax_cal.reporting.html.motion import compose_motion, motion_of

WORDING = Wording("2026-11-25", author="A. Smith")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motion diagnosis that names the rotor of joint 3."""

    def rotor(motion: Motion, rigid: Array, time: Array) -> Array:
        return np.stack([0.0 * time, 0.0 * time, 0.3 * motion.qdd[:, 2]], axis=1)

    path = tmp_path_factory.mktemp("motion") / "motion.json"
    mc.diagnose_motion(three_joints(), simulated(rotor, seed=3)).save(path)
    return path


def test_sections_hold_the_budget_the_curves_and_the_run_left_out(saved):
    source = motion_of([saved])
    assert source
    page = compose_motion(source, WORDING)
    blocks = {section.name: section.blocks for section in page.sections}
    budget = [one for one in blocks["budget"] if isinstance(one, Table)]
    last = source.found.budget[-1]
    assert budget[0].rows[-1] == (last.name, *last.holdout_rms)
    assert budget[1].rows[-1] == (last.name, *last.holdout_rms_moving)
    figures = [one for one in blocks["torques"] if isinstance(one, Figure)]
    assert [one.name for one in figures] == ["joint-1", "joint-2", "joint-3"]
    measured, predicted, band, curve = figures[2].traces
    assert measured["y"] == pytest.approx(source.found.held_run.measured[2], rel=1e-5)
    assert predicted["y"] == pytest.approx(source.found.held_run.predicted[2], rel=1e-5)
    assert len(band["y"]) == 2 * len(curve["y"])
    assert f"{last.holdout_rms_moving[2]:.3g} N m" in figures[2].says
    assert blocks["provenance"][0].rows[0][2] == source.file.digest  # type: ignore[union-attr]


def test_the_command_writes_one_page(saved, capsys):
    page = saved.with_name("report.html")
    assert run("report", saved, "-o", page, "--author", "A. Smith", "--date", "2026-11-25") == 0
    said = capsys.readouterr().out
    assert "rotor inertia at J3" in said
    html = page.read_text()
    assert re.search(r'class="kind">\s*Motion diagnosis', html)
    assert "rotor inertia at J3" in html
    assert html.count('id="figure-joint-') == 3


def test_what_is_of_positions_is_refused_and_it_stands_alone(saved, capsys):
    assert run("report", saved, "--tolerance", "rms 0.2", "-o", saved.with_name("a.html")) == 2
    assert "is of positions" in capsys.readouterr().err
    assert run("report", saved, saved, "-o", saved.with_name("a.html")) == 2
    assert "report it alone" in capsys.readouterr().err
    other = saved.with_name("other.json")
    other.write_text(json.dumps({**json.loads(saved.read_text()), "schema": 2}))
    assert run("report", other, "-o", saved.with_name("a.html")) == 2
    assert "is of schema 2, this version knows 1" in capsys.readouterr().err

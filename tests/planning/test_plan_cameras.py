"""Images of a camera cell: what is planned can be seen, and tells the arm as well as promised."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments.pixel_cells import (
    NOISE,
    SIZE,
    Cell,
    View,
    arm_error,
    board_points,
    data_of,
    make_cell,
    projected,
    taken,
    write_cell,
)
from minimax_cal.fitting.pixels.calibrate import determined, fitted
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.ground.arrays import Array
from minimax_cal.planning.result import Plan
from minimax_cal.robots.transforms import inverse

ROOT = Path(__file__).parents[2]
POSES, DISTANCE, INCIDENCE = 16, (0.35, 0.75), np.radians(45.0)
TWO = (
    View(np.eye(4)),
    View(np.array([[1.0, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])),
)

ONE = pytest.mark.parametrize("cell", [True], ids=["eye in hand"], indirect=True)

pytestmark = pytest.mark.usefixtures("few_candidates")


def planned(cell: Cell, folder: Path, **more: object) -> Plan:
    """A plan for a cell whose files are in a folder."""
    write_cell(cell, folder)
    given = {
        "camera_on": "flange" if cell.on_flange else "ground",
        "camera_at": tuple(view.pose for view in cell.views), "board_at": cell.place,
        "print_looks": "z", "distance": DISTANCE, "incidence": INCIDENCE, "jitter": 0.0,
        "pixel_noise": NOISE, "candidates": 100,
    }  # fmt: skip
    cameras = {f"cam{i}": folder / f"cam{i}.yaml" for i in range(len(cell.views))}
    return mc.plan_cameras(cell.drawn, POSES, cameras, folder / "board.csv", **given | more)


@pytest.fixture(scope="module", params=[True, False], ids=["eye in hand", "eye to hand"])
def cell(request: pytest.FixtureRequest) -> Cell:
    points = board_points((4, 3), 0.06)
    return make_cell(np.random.default_rng(2), points=points, poses=4, on_flange=request.param)


@pytest.fixture(scope="module")
def plan(cell: Cell, few_candidates: None, tmp_path_factory: pytest.TempPathFactory) -> Plan:
    return planned(cell, tmp_path_factory.mktemp("plan"))


def in_camera(cell: Cell, q: Array, view: View) -> Array:
    """(m, 4, 4) the board in a camera of the drawn arm."""
    flange = cell.drawn.pose(q)
    if cell.on_flange:
        return np.asarray(inverse(flange @ view.pose) @ cell.place)
    return np.asarray(inverse(view.pose) @ flange @ cell.place)


def check_seen(cell: Cell, plan: Plan, share: float = 0.8) -> None:
    """Every image that counts shows enough corners, near enough, not too flatly."""
    assert plan.seen.any(axis=1).all()
    for number, view in enumerate(cell.views):
        board = in_camera(cell, plan.q[plan.seen[:, number]], view)
        local = np.einsum("mij,kj->mki", board[:, :3, :3], cell.points) + board[:, None, :3, 3]
        pixel = projected(replace(view, size=(10**5, 10**5)), local + 0.0)
        inside = ((pixel >= 0.0) & (pixel <= np.array(SIZE) - 1.0)).all(axis=-1)
        assert (inside.mean(axis=1) >= share - 0.07).all()  # `projected` keeps off the edge
        away = np.linalg.norm(board[:, :3, 3], axis=1)
        assert (away >= DISTANCE[0]).all()
        assert (away <= DISTANCE[1]).all()
        assert (-(board[:, :3, 3] * board[:, :3, 2]).sum(axis=1) >= away * np.cos(INCIDENCE)).all()


def test_planned_poses_see_the_board(cell, plan):
    check_seen(cell, plan)
    assert (plan.q >= np.maximum(cell.drawn.lower, -np.pi)).all()
    assert plan.efficiency > 0.6  # a few whole poses cost
    assert plan.cameras == ("cam0",)
    assert plan.to_dict()["instrument"]["noise_px"] == NOISE
    assert plan.still == ("board" if cell.on_flange else "camera")


@ONE
def test_planned_poses_reach_the_predicted_sigma_and_beat_random_ones(cell, plan):
    rng, here = np.random.default_rng(5), plan.here
    assert here.mean[0] < 0.75 * here.mean[1]
    random = plan.candidates.q[: plan.candidates.drawn]
    errors = []
    for _ in range(6):
        some = random[rng.choice(len(random), POSES, replace=False)]
        for q in (plan.q, some):
            made = taken(cell, q, rng)
            options = PixelOptions(camera_on="flange" if cell.on_flange else "ground", holdout=0.0)
            fit = fitted(cell.drawn, data_of(made), options)
            errors.append(arm_error(cell, fit.calibrated or fit.robot))
    own, others = np.sqrt(np.mean(np.square(np.array(errors).reshape(-1, 2)), axis=0))
    assert 0.7 < own / (1e3 * here.mean[0]) < 1.4
    assert own < 0.85 * others


def test_information_is_that_of_the_fit(cell, tmp_path):
    """The predicted covariance of all parameters is that by the noise of a calibration."""
    on = "flange" if cell.on_flange else "ground"
    true = planned(replace(cell, drawn=cell.true), tmp_path)
    same = taken(cell, true.q, np.random.default_rng(0))
    known = determined(cell.true, data_of(same), PixelOptions(camera_on=on, holdout=0.0))
    every = known.fit.problem.names.all
    links = [name for name in true.names if name in every[: 5 * cell.true.joints]]
    own = true.sigma[[true.names.index(name) for name in links]]
    theirs = np.sqrt(np.diag(known.sure.noise)[[every.index(name) for name in links]])
    assert_allclose(own, theirs, rtol=0.1)  # `taken` has no corners at the edge of an image


@ONE
def test_jitter_tells_less(cell, plan, tmp_path):
    shaken = planned(cell, tmp_path, jitter=1e-4)
    assert shaken.here.mean[0] > 1.5 * plan.here.mean[0]


def test_two_cameras_are_planned_together(tmp_path):
    points = board_points((4, 3), 0.06)
    cell = make_cell(np.random.default_rng(3), points=points, poses=4, views=TWO)
    both = planned(cell, tmp_path, criterion="D", candidates=60)
    check_seen(cell, both)
    assert both.seen.shape == (POSES, 2)
    assert both.seen.all(axis=0).any() or both.seen.any(axis=0).all()


# ---- the command -----------------------------------------------------------------------------


def test_the_command_of_the_page_runs(tmp_path, says, monkeypatch):
    cell = make_cell(np.random.default_rng(2), points=board_points((4, 3), 0.06), poses=4)
    write_cell(cell, tmp_path)
    (tmp_path / "cam0.yaml").rename(tmp_path / "camera.yaml")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "pixels.md").read_text().replace("\\\n", "")
    line = re.search(r"^minimax-cal (plan .*)$", page, re.M)
    assert line is not None
    picture = tmp_path / "plan.svg"
    command = shlex.split(line[1])
    said, told = says(*command, "--candidates", 50, "--figure", picture)
    assert "Predicted sigma of a position" in said
    assert "noise of a pixel 0.1 px" in told
    written = Path(command[command.index("-o") + 1]).read_text()
    assert written.startswith("order,pose,q1_deg")
    assert "expected" not in written
    assert picture.exists()


def test_a_calibration_places_cameras_and_board(cell, plan, tmp_path, answered, refuses):
    fit = tmp_path / "fit.json"
    files = write_cell(taken(cell, plan.q, np.random.default_rng(1)), tmp_path)
    see = ["--camera", f"cam0={tmp_path / 'cam0.yaml'}", "--board", tmp_path / "board.csv",
           "--print-looks", "z", "--candidates", 50, "--fit", fit]  # fmt: skip
    assert run("calibrate ur5", *files, "-o", fit) == 0
    content = answered("plan ur5 --poses 12", *see)
    assert content["cameras"] == ["cam0"]
    assert content["settings"]["camera_on"] == ("flange" if cell.on_flange else "ground")
    assert_allclose(content["settings"]["board_at"], cell.place, rtol=0, atol=3e-3)
    refuses(
        "leave --camera-at and --board-at out",
        "plan ur5 --poses 12",
        *see,
        "--board-at",
        "0,0,0,0,0,0",
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("--camera", "a=b"), "images need both --camera"),
        (
            ("--camera", "a=b", "--board", "c", "--tracker", "1,2,3"),
            "--tracker is about poses, not",
        ),
        (("--camera", "a=b", "--board", "c", "--motion"), "--board is about cameras; add --camera"),
        (("--camera-at", "0,0,0,0,0,0"), "--camera-at is about cameras"),
        (("--camera", "a=b", "--board", "c"), "give --camera-at for each"),
        (("--camera", "a=b", "--board", "c", "--camera-at", "1"), "give X,Y,Z in mm"),
        (("--camera", "a=b", "--camera", "a=c", "--board", "c"), "one name twice"),
        (("--camera", "a=b", "--board", "c", "--share", "2"), "--share 2"),
        (("--camera", "a=b", "--board", "c", "--print-looks", "x"), "--print-looks"),
    ],
)
def test_wrong_input_is_one_line(given, said, says):
    at = ("--camera-at", "0,0,80,0,0,0", "--board-at", "500,0,0,0,0,0")
    more = at if {"--share", "--print-looks"} & set(given) else ()
    err = says("plan ur5 --poses 12", *given, *more, code=2).err
    assert said in err
    assert len(err.strip().splitlines()) == 1


@ONE
def test_a_board_that_nothing_sees_is_said(cell, tmp_path):
    far = cell.place.copy()
    far[:3, 3] += 10.0
    with pytest.raises(mc.OptionError, match="can be taken and seen"):
        planned(cell, tmp_path, board_at=far)

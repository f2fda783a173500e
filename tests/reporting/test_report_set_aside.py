"""What was set aside stands beside the verdict on page one, and may take it back."""

from pathlib import Path

import numpy as np
import pytest
from conftest import run
from test_report import WORDING, Seen

import minimax_cal as mc
from minimax_cal.judging.tolerance import NOT_PASSED, PASSED, limits_of
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting.html import compose, page, read_sources
from minimax_cal.reporting.html.first_page import signed

BAD = 5


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """poses.csv with 2 % of the poses off by 1 mm; used.csv with these unticked, as on the page."""
    folder = tmp_path_factory.mktemp("aside")
    truth = Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)
    data = simulate("irb120", 250, 2, seed=3, truth=truth).data
    rng = np.random.default_rng(0)
    rows = rng.choice(250, BAD, replace=False)
    by = rng.normal(size=(BAD, 1, 3))
    y = data.y.copy()
    y[rows] += 1e-3 * by / np.linalg.norm(by, axis=-1, keepdims=True)
    mc.write_measurements(folder / "poses.csv", data.with_y(y))
    points = ",".join(str(line) for line in data.line[rows])
    left = f"--leave-out={points}=looks odd"
    assert run("import", folder / "poses.csv", left, "-o", folder / "used.csv", "--quiet") == 0
    for name in ("poses", "used"):
        mc.calibrate("irb120", folder / f"{name}.csv", "sum").save(folder / f"{name}.json")
    mc.diagnose("irb120", folder / "used.csv", quick=True).save(folder / "gap.json")
    return folder


def test_passed_only_without_them_is_said_in_the_verdict_line(files, capsys):
    fit, out = mc.load_fit(files / "used.json"), files / "report.html"
    counted = fit.accuracy["holdout_with_them"].rms_mm
    assert run("report", files / "used.json", "--tolerance", "rms 0.1", "-o", out) == 0
    first, *others = capsys.readouterr().out.splitlines()
    said = f"without {2 * BAD} points set aside by the user; with them RMS {counted:.3f} mm"
    assert first == f"{PASSED} {said}: {NOT_PASSED}"
    assert any("Why: looks odd (10)" in line for line in others)
    verdict = Seen(out.read_text()).text["verdict"]
    assert f"Passed {said}: {NOT_PASSED}" in verdict
    assert f"RMS, inside, with {2 * BAD} points set aside" in verdict
    assert "Why: looks odd (10)" in verdict


def test_with_room_enough_it_is_passed_with_them_too(files):
    found = signed(read_sources([files / "used.json"]), limits_of("rms 2"), "inside", None)
    assert found.sentence == found.verdict == PASSED
    assert found.lines()[2].startswith(f"{2 * BAD} points set aside by the user; with them RMS")


def test_a_diagnosis_alone_says_it_as_well(files):
    found = signed(read_sources([files / "gap.json"]), limits_of("rms 0.1"), "inside", None)
    assert found.verdict == PASSED
    assert found.sentence.startswith(f"{PASSED} without {2 * BAD} points set aside by the user")


def test_without_any_the_page_says_so(files):
    sources = read_sources([files / "poses.json"])
    found = signed(sources, limits_of("rms 2"), "inside", None)
    assert (found.set_aside, found.judged_with) == ((), ())
    assert "No measured point was set aside." in page.render(compose(sources, WORDING))

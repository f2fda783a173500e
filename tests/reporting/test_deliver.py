"""The page to sign judges a requirement by what leaves the house, and not by a model of no file."""

import pytest

import minimax_cal as mc
from minimax_cal.judging.tolerance import NOT_PASSED, NOT_STATED, PASSED, limits_of
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting.html import read_sources
from minimax_cal.reporting.html.first_page import Signed, signed
from tests.conftest import run

EFFECTS = "joint_compliance:all"


@pytest.fixture(scope="module")
def fit() -> mc.Fit:
    """Compliance, and a drift that ends with the session."""
    made = simulate("irb2600", 120, 3, seed=4, truth=Truth(compliance=3e-6))
    return mc.calibrate("irb2600", made.data, "sum", effects=f"{EFFECTS},frame_drift:frame")


@pytest.fixture(scope="module")
def between(fit: mc.Fit) -> str:
    """A requirement that corrected targets keep, and geometry alone does not."""
    low, high = (mc.deliver(fit, to).figures.rms for to in ("compensate", "urdf"))
    assert 3.0 * low < high
    return f"rms {0.5 * (low + high):.4f}"


def judged(fit: mc.Fit, limits: str, *deliver: str) -> Signed:
    return signed(read_sources([fit]), limits_of(limits), "inside", None, deliver)


def test_a_file_is_judged_by_what_it_reaches(fit, between):
    """The same fit passes for corrected targets and not for a URDF."""
    for names, verdict, of in (
        ((), PASSED, "compensate"),
        (("compensate",), PASSED, "compensate"),
        (("urdf",), NOT_PASSED, "urdf"),
        (("mjcf", "json"), NOT_PASSED, "json"),
        (("mjcf", "compensate"), PASSED, "mjcf"),
    ):
        found = judged(fit, between, *names)
        assert found.verdict == verdict
        assert found.row
        own = mc.deliver(fit, of)
        assert found.row.delivered.format == of
        assert found.claims[0].rms.value == pytest.approx(own.figures.rms, rel=1e-9)
        told = [row.delivered.format for row in found.rows]
        assert told == list(names or ("compensate", "urdf"))
    rows = judged(fit, between).rows
    assert [row.verdict for row in rows] == [PASSED, NOT_PASSED]
    assert "frame_drift:frame" in rows[0].delivered.not_carried


def test_geometry_alone_is_its_own_deliverable(between):
    made = simulate("irb2600", 120, 3, seed=4)
    plain = mc.calibrate("irb2600", made.data, "sum")
    alone = judged(plain, between)
    assert alone.row is None
    named = judged(plain, between, "urdf")
    assert named.row
    assert named.claims == alone.claims
    assert named.verdict == alone.verdict


def test_without_measurements_nothing_is_stated(fit, between, tmp_path):
    fit.save(tmp_path / "fit.json", poses=False)
    found = judged(mc.load_fit(tmp_path / "fit.json"), between, "urdf")
    assert found.verdict == NOT_STATED
    assert "holds no measurements" in found.judged[0].why


def test_the_page_and_the_command_say_for_which_file(fit, between, tmp_path, capsys):
    fit.save(tmp_path / "fit.json")
    asked = ("report", tmp_path / "fit.json", "--tolerance", between, "-o", tmp_path / "page.html")
    assert run(*asked) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == PASSED
    assert any(
        "hold for joint targets corrected by minimax-cal compensate" in line for line in rest
    )
    assert any(line.startswith("urdf: not passed: urdf holds geometry alone") for line in rest)
    page = (tmp_path / "page.html").read_text()
    assert "Files and corrected targets" in page
    assert run(*asked, "--deliver", "urdf", "--deliver", "ros-yaml") == 0
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == NOT_PASSED
    assert any(
        "hold for the urdf file of minimax-cal export (geometry alone)" in line for line in rest
    )
    assert sum(line.startswith(("urdf: ", "ros-yaml: ")) for line in rest) == 2
    assert run(*asked, "--deliver", "step") == 2
    assert "no such format; choose one of urdf" in capsys.readouterr().err

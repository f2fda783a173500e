"""The page to sign: which number, which verdict, what limits it; facts from a TOML."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from dynamics.motions import simulated, three_joints
from numpy.testing import assert_allclose
from test_report import WORDING, Seen

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.diagnosing.diagnosis import load_diagnosis
from minimax_cal.dynamics.regressor import JointMotion
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting import report_file
from minimax_cal.reporting.html import ChartBlock, build_report, html_page, read_report_sources
from minimax_cal.reporting.html.cell_facts import FACT_LABELS
from minimax_cal.reporting.html.first_page import (
    ReportJudgement,
    describe_most_rotated_joint,
    judge_sources,
)
from minimax_cal.reporting.html.motion_report import build_motion_report, find_motion_diagnosis
from minimax_cal.reporting.html.report_builder import ReportRequest
from minimax_cal.reporting.html.report_sources import ReportSources
from minimax_cal.validation.tolerance import NOT_PASSED, NOT_STATED, PASSED, parse_tolerance_limits

# ---- first page ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(results: Path) -> Path:
    """The calibration with the effects of the diagnosis."""
    path = results / "whole.json"
    mc.calibrate("ur10", results / "poses.csv", "sum", effects=results / "gap.json").save(path)
    return path


def rendered(wording: ReportRequest, *paths: Path) -> Seen:
    return Seen(html_page.render_html(build_report(read_report_sources(paths), wording)))


def rows(seen: Seen) -> dict[str, list[str]]:
    """The table of the result: after what an error is of, and which, the cells of its row."""
    title, every = next((t, found) for t, found in seen.tables.items() if " [mm]" in t)
    first = 2 if title.startswith("Result by") else 1
    return {", ".join(row[:first]): row[first:] for row in every}


def test_requirement_result_and_verdict(whole, tmp_path, says):
    fit, out = mc.load_fit(whole), tmp_path / "report.html"
    high = 1e3 * fit.within.rms.high
    low = 1e3 * fit.within.rms.low
    for size, verdict, code in (
        (1.1 * high, "passed", 0),
        (0.5 * fit.within.after.rms_mm, "not passed", 1),
    ):
        told = ("report", whole, "--tolerance", f"rms {size:.6f}", "-o", out)
        stdout, stderr = says(*told, code=code)
        where = f"{' inside the measured region' * (not code)} for corrected targets"
        assert stdout.splitlines()[0] == f"{verdict}{where}"
        assert re.search(f"RMS, inside +{fit.within.after.poses} ", stdout)
        assert f"written: {out}" in stderr
        assert ("error: RMS error at most" in stderr) == bool(code)
        seen = Seen(out.read_text())
        poses, before, after, limit, said = rows(seen)["corrected targets, RMS, inside"]
        assert poses == f"{fit.within.after.poses}"
        assert (before, after) == (f"{fit.within.before.rms_mm:.3f}",
                                   f"{fit.within.after.rms_mm:.3f}")  # fmt: skip
        assert (limit, said) == (f"{low:.3f} to {high:.3f}", verdict)
        assert any(
            f"required: RMS at most {size:.6f}".rstrip("0") in title for title in seen.tables
        )
        assert f"{verdict.capitalize()}{where}" in seen.text["verdict"]


def test_beyond_is_asked_of_the_worst_part(whole, tmp_path, refuses, says):
    fit = mc.load_fit(whole)
    out = tmp_path / "report.html"
    size = 0.5 * (fit.within.rms.high * 1e3 + fit.beyond.rms_high_mm)
    assert 1e3 * fit.within.rms.high < size < fit.beyond.rms_high_mm
    told = ("report", whole, "--tolerance", f"rms {size:.6f}", "-o", out, "-q")
    assert says(*told).out.startswith("passed")
    assert says(*told, "--tolerance-for", "outside", code=1).out.startswith("not passed")
    row = rows(Seen(out.read_text()))
    worst = f"corrected targets, RMS, outside ({fit.beyond.worst.where})"
    assert row[worst][-1] == "not passed"
    refuses("choose inside or outside", *told, "--tolerance-for", "above")


def test_an_arm_of_half_its_lengths_is_not_signed_unseen(robot, tmp_path, says):
    """Points that are scaled by half give links of half their length: told on the sheet itself."""
    made = mc.simulate(robot, 60, seed=4)
    for factor, told in ((0.5, True), (1.0, False)):
        fit = mc.calibrate(robot, made.data.with_y(factor * made.data.y))
        fit.save(tmp_path / "fit.json")
        page = tmp_path / "report.html"
        asked = ("report", tmp_path / "fit.json", "--tolerance", "rms 5", "-o", page, "-q")
        said = says(*asked, code=int(told)).out
        assert said.startswith("not passed" if told else "passed")  # it has failed
        assert ("Implausibly large changes: a1 by" in said) == told
        assert ("another arm's" in Seen(page.read_text()).text["verdict"]) == told


def test_the_page_says_which_model_is_signed(results, whole):
    plain = rendered(WORDING, results / "fit.json", results / "gap.json")
    assert any(title == "Model: geometry alone [mm]" for title in plain.tables)
    text = plain.text["verdict"]
    assert "Signed is the calibration (geometry alone)" in text
    assert "Main cause: joint compliance of the whole arm (gearboxes wind up" in text
    both = rendered(WORDING, whole, results / "gap.json")
    assert "corrected targets, RMS, inside" in rows(both)
    assert "Signed is the calibration" not in both.text["verdict"]
    # all that these data tell of the noise is that of the instrument
    assert "is the instrument's noise" in both.text["budget"]
    # parameters of effects stand once: with the fit if it has them
    assert "parameters of the effects" in plain.tables
    assert "parameters of the effects" not in both.tables
    assert "effects beyond geometry" in both.tables


def test_the_worst_joint_is_the_one_that_effects_turn_most(whole, results):
    """The rigid arm at joints turned so sees the targets where the arm with its effects does."""
    fit = mc.load_fit(whole)
    (said,) = describe_most_rotated_joint(read_report_sources([whole]))
    known = re.search(r"joint (\d), turned ([\d.]+) degrees .*\(line (\d+);", said)
    assert known
    turn = fit.cell.effects.joint_shifts(fit.cell.pose_arm(add_history_columns(fit.data)))
    rigid = replace(fit.cell, effects=type(fit.cell.effects)((), ()))
    assert_allclose(rigid.predict(fit.data.q + turn), fit.cell.predict(fit.data.q), atol=1e-12)
    assert float(known[2]) == pytest.approx(np.degrees(np.abs(turn).max()), abs=5e-4)
    row = np.flatnonzero(fit.data.line == int(known[3]))[0]
    assert abs(turn[row, int(known[1]) - 1]) == np.abs(turn).max()
    assert not list(
        describe_most_rotated_joint(read_report_sources([results / "fit.json"]))
    )  # geometry turns none


def test_pages_say_how_far_effects_turn_a_joint_and_by_which_parameters(whole, results):
    fit, seen = mc.load_fit(whole), rendered(WORDING, whole, results / "gap.json")
    turn = 1e3 * np.abs(
        fit.cell.effects.joint_shifts(fit.cell.pose_arm(add_history_columns(fit.data)))
    )
    joints = seen.tables["error after geometry, as rotations of each joint alone"][1:]
    assert [row[-2] for row in joints] == [f"{most:.4f}" for most in turn.max(axis=0)]
    assert [row[-1] for row in joints] == [f"line {fit.data.line[i]}" for i in turn.argmax(axis=0)]
    effects = next(rows for title, rows in seen.tables.items() if "beyond geometry" in title)
    known = [p for p in fit.parameters if p.is_of_effect and p.identifiable]
    assert all(f"{p.value:.4g}" in str(effects) for p in known)
    kept = [p for p in fit.parameters if not p.identifiable]
    whys = [p.reason_for_display if p.is_of_effect else p.why_not for p in kept]
    assert kept
    assert all(why in seen.text["parameters"] for why in whys)


def test_rungs_of_a_diagnosis(results, tmp_path):
    gap = load_diagnosis(results / "gap.json")
    for number, step in ((0, gap.ladder[0]), (1, gap.ladder[1]), (None, gap.ladder[-1])):
        wording = ReportRequest("2026-11-21", rung=number)
        found = rows(rendered(wording, results / "gap.json"))
        found = found.get("RMS, inside") or found["corrected targets, RMS, inside"]
        assert found[0] == f"{step.holdout.poses}"
        assert found[2] == f"{step.holdout.rms_mm:.3f}"
    with pytest.raises(mc.OptionError, match="no step 7"):
        mc.report(gap, tmp_path / "a.html", rung=7)
    with pytest.raises(mc.OptionError, match="only a report of a diagnosis alone has steps"):
        mc.report(results / "fit.json", tmp_path / "a.html", rung=1)


def test_too_few_poses_leave_a_maximum_open(robot, tmp_path):
    """Nine held-out poses, and none in turn: the file of an earlier version."""
    fit = mc.calibrate(robot, mc.simulate(robot, 45, 3, seed=2).data, "sum")
    content = fit.to_dict()
    del content["accuracy"]["cv"], content["arrays"]["crossed"]
    mc.Fit.from_dict(content).save(tmp_path / "old.json")
    wording = ReportRequest("2026-11-21", limits=parse_tolerance_limits("max 5"))
    text = rendered(wording, tmp_path / "old.json").text["verdict"]
    assert "Not stated" in text
    assert "9 poses are too few for a maximum: at least 19 are needed" in text


def test_facts_are_of_the_file_or_to_be_filled_in(results, tmp_path, refuses):
    toml, out = tmp_path / "cell.toml", tmp_path / "report.html"
    toml.write_text('serial_number = "26-104711"\npayload = 12\ncustomer = "<b>Example</b>"\n')
    assert run("report", results / "fit.json", "--facts", toml, "-o", out) == 0
    text = out.read_text()
    assert "<dd>26-104711</dd>" in text
    assert "<dd>12</dd>" in text
    assert "&lt;b&gt;Example&lt;/b&gt;" in text
    assert text.count('class="blank"') == len(FACT_LABELS) - 2
    for content, words in (
        ('serial = "1"', "the key 'serial' is not known"),
        ("serial_number = ", "is not TOML"),
        ("[tool]\na = 1", "tool must be a text or a number"),
    ):
        toml.write_text(content)
        refuses(words, "report", results / "fit.json", "--facts", toml, "-o", out)


@pytest.mark.usefixtures("browser")
def test_paper_and_picture_by_the_ending(results, tmp_path, monkeypatch):
    assert run("report", results / "fit.json", "-o", tmp_path / "page.png") == 0
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")
    printed: list[tuple[str, Path]] = []  # by a browser in `test_pdf_holds_the_whole_report`
    monkeypatch.setattr(
        report_file, "write_pdf", lambda page, path, _: printed.append((page, path))
    )
    assert run("report", results / "fit.json", "-o", tmp_path / "page.pdf") == 0
    ((text, path),) = printed
    assert path == tmp_path / "page.pdf"
    assert "budget" in Seen(text).text


# ---- deliver -------------------------------------------------------------------------------------


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


def judged(fit: mc.Fit, limits: str, *deliver: str) -> ReportJudgement:
    return judge_sources(
        read_report_sources([fit]), parse_tolerance_limits(limits), "inside", None, deliver
    )


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
        assert found.governing_row
        own = mc.deliver(fit, of)
        assert found.governing_row.delivered.format == of
        assert found.claims[0].rms.value == pytest.approx(own.figures.rms, rel=1e-9)
        told = [row.delivered.format for row in found.rows]
        assert told == list(names or ("compensate", "urdf", "mjcf"))
    rows = judged(fit, between).rows
    assert [row.verdict for row in rows] == [PASSED, NOT_PASSED, PASSED]
    assert "frame_drift:frame" in rows[0].delivered.not_carried


def test_geometry_alone_is_its_own_deliverable(between):
    made = simulate("irb2600", 120, 3, seed=4)
    plain = mc.calibrate("irb2600", made.data, "sum")
    alone = judged(plain, between)
    assert alone.governing_row is None
    named = judged(plain, between, "urdf")
    assert named.governing_row
    assert named.claims == alone.claims
    assert named.verdict == alone.verdict


def test_without_measurements_nothing_is_stated(fit, between, tmp_path):
    fit.save(tmp_path / "fit.json", poses=False)
    found = judged(mc.load_fit(tmp_path / "fit.json"), between, "urdf")
    assert found.verdict == NOT_STATED
    assert "holds no measurements" in found.judgements[0].why


def test_the_page_and_the_command_say_for_which_file(fit, between, tmp_path, refuses, says):
    fit.save(tmp_path / "fit.json")
    asked = ("report", tmp_path / "fit.json", "--tolerance", between, "-o", tmp_path / "page.html")
    first, *rest = says(*asked).out.splitlines()
    assert first.startswith(PASSED)
    assert any(
        "hold for joint targets corrected by minimax-cal compensate" in line for line in rest
    )
    assert any(line.startswith("Urdf file: cannot hold ") for line in rest)
    assert any(re.match(" +urdf file +.* not passed", line) for line in rest)
    page = (tmp_path / "page.html").read_text()
    assert "Result by deliverable" in page
    first, *rest = says(
        *asked, "--deliver", "urdf", "--deliver", "ros-yaml", code=1
    ).out.splitlines()
    assert first == f"{NOT_PASSED} for urdf file"
    assert any(
        "hold for the urdf file of minimax-cal export (geometry alone)" in line for line in rest
    )
    assert sum(line.startswith(("Urdf file: ", "Ros-yaml file: ")) for line in rest) == 2
    refuses("no such format; choose one of urdf", *asked, "--deliver", "step")


# ---- report set aside ----------------------------------------------------------------------------


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


def test_passed_only_without_them_is_said_in_the_verdict_line(files, says):
    fit, out = mc.load_fit(files / "used.json"), files / "report.html"
    counted = fit.accuracy["holdout_with_them"].rms_mm
    first, *others = says(
        "report", files / "used.json", "--tolerance", "rms 0.1", "-o", out
    ).out.splitlines()
    said = f"without {2 * BAD} points set aside by the user; with them RMS {counted:.3f} mm"
    assert first == f"{PASSED} {said}: {NOT_PASSED}"
    assert any("Why: looks odd (10)" in line for line in others)
    verdict = Seen(out.read_text()).text["verdict"]
    assert f"Passed {said}: {NOT_PASSED}" in verdict
    assert f"RMS, inside, with {2 * BAD} points set aside" in verdict
    assert "Why: looks odd (10)" in verdict


def test_outliers_that_were_kept_are_named(files):
    fit = mc.load_fit(files / "poses.json")
    text = rendered(WORDING, files / "poses.json").text["verdict"]
    assert f"{len(fit.suspects)} outliers were kept" in text
    worst = max(fit.suspects, key=lambda one: one.distance)
    assert f"line {worst.line} {worst.target} {1e3 * worst.distance:.2f} mm" in text
    assert "kept, as" not in rendered(WORDING, files / "used.json").text["verdict"]


def test_with_room_enough_it_is_passed_with_them_too(files):
    found = judge_sources(
        read_report_sources([files / "used.json"]), parse_tolerance_limits("rms 2"), "inside", None
    )
    assert (found.requirement_verdict_sentence, found.verdict) == (
        f"{PASSED} inside the measured region",
        PASSED,
    )
    assert found.list_terminal_lines()[2].startswith(
        f"{2 * BAD} points set aside by the user; with them RMS"
    )


def test_a_diagnosis_alone_says_it_as_well(files):
    found = judge_sources(
        read_report_sources([files / "gap.json"]), parse_tolerance_limits("rms 0.1"), "inside", None
    )
    assert found.verdict == PASSED
    assert found.requirement_verdict_sentence.startswith(
        f"{PASSED} without {2 * BAD} points set aside by the user"
    )


def test_without_any_the_page_says_so(files):
    sources = read_report_sources([files / "poses.json"])
    found = judge_sources(sources, parse_tolerance_limits("rms 2"), "inside", None)
    assert (found.set_aside, found.judgements_with_set_aside) == ((), ())
    assert "No measured point was set aside." in html_page.render_html(
        build_report(sources, WORDING)
    )


def test_what_one_of_two_results_sets_aside_is_said(files):
    """The calibration sets nothing aside, and the diagnosis of the same measurements does."""
    fit, gap = mc.load_fit(files / "used.json"), load_diagnosis(files / "gap.json")
    found = judge_sources(ReportSources(replace(fit, set_aside=()), gap), (), "inside", None)
    assert found.set_aside_sentences[0].startswith(
        f"In the diagnosis: {2 * BAD} points set aside by the user"
    )
    both = judge_sources(ReportSources(fit, gap), (), "inside", None)
    assert [said[:22] for said in both.set_aside_sentences] == [
        f"{2 * BAD} points set aside by"
    ]  # once, of both


# ---- report motion -------------------------------------------------------------------------------


MOTION_WORDING = ReportRequest("2026-11-25", author="A. Smith", appendix=True)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motion diagnosis that names the rotor of joint 3."""

    def rotor(motion: JointMotion, rigid: Array, time: Array) -> Array:
        return np.stack([0.0 * time, 0.0 * time, 0.3 * motion.qdd[:, 2]], axis=1)

    path = tmp_path_factory.mktemp("motion") / "motion.json"
    mc.diagnose_motion(three_joints(), simulated(rotor, seed=3)).save(path)
    return path


def test_sections_hold_the_budget_the_curves_and_the_run_left_out(saved):
    source = find_motion_diagnosis([saved])
    assert source
    page = build_motion_report(source, MOTION_WORDING)
    blocks = {section.name: section.blocks for section in page.sections}
    budget = [one for one in blocks["budget"] if isinstance(one, Table)]
    last = source.diagnosis.budget[-1]
    assert budget[0].rows[-1] == (last.name, *last.holdout_rms)
    assert budget[1].rows[-1] == (last.name, *last.holdout_rms_moving)
    figures = {one.name: one for one in blocks["where"] if isinstance(one, ChartBlock)}
    assert sorted(figures) == ["joint-1", "joint-2", "joint-3"]
    measured, predicted, band, curve = figures["joint-3"].traces
    assert measured["y"] == pytest.approx(source.diagnosis.held_run.measured[2], rel=1e-5)
    assert predicted["y"] == pytest.approx(source.diagnosis.held_run.predicted[2], rel=1e-5)
    assert len(band["y"]) == 2 * len(curve["y"])
    assert f"{last.holdout_rms_moving[2]:.3g} N m" in figures["joint-3"].says
    assert blocks["provenance"][0].rows[0][2] == source.file.digest


def test_the_command_writes_one_page(saved, says):
    page = saved.with_name("report.html")
    said = says("report", saved, "-o", page, "--author", "A. Smith", "--date", "2026-11-25").out
    assert "rotor inertia at J3" in said
    html = page.read_text()
    assert re.search(r'class="kind">\s*Motion diagnosis', html)
    assert "rotor inertia at J3" in html
    assert html.count('id="figure-joint-') == 3


def test_what_is_of_positions_is_refused_and_it_stands_alone(saved, refuses):
    refuses(
        "is of positions",
        "report",
        saved,
        "--tolerance",
        "rms 0.2",
        "-o",
        saved.with_name("a.html"),
    )
    refuses("report it alone", "report", saved, saved, "-o", saved.with_name("a.html"))
    other = saved.with_name("other.json")
    other.write_text(json.dumps({**json.loads(saved.read_text()), "schema": 2}))
    refuses(
        "is of schema 2, this version knows 1", "report", other, "-o", saved.with_name("a.html")
    )

"""The page to sign: which number, which verdict, what limits it; facts from a TOML."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import run
from test_report import WORDING, Seen

import minimax_cal as mc
from minimax_cal.diagnosing.result import load_diagnosis
from minimax_cal.judging.tolerance import limits_of
from minimax_cal.measuring.floor import AT_MOST, Floor
from minimax_cal.reporting import report
from minimax_cal.reporting.html import compose, page, read_sources
from minimax_cal.reporting.html.document import Wording
from minimax_cal.reporting.html.facts import FACTS
from minimax_cal.reporting.html.first_page import left_now, limits_now, signed
from minimax_cal.reporting.html.sources import Sources


@pytest.fixture(scope="module")
def whole(results: Path) -> Path:
    """The calibration with the effects of the diagnosis."""
    path = results / "whole.json"
    mc.calibrate("ur10", results / "poses.csv", "sum", effects=results / "gap.json").save(path)
    return path


def rendered(wording: Wording, *paths: Path) -> Seen:
    return Seen(page.render(compose(read_sources(paths), wording)))


def rows(seen: Seen) -> dict[str, list[str]]:
    """The table of the result by what its first cells name, their poses before the rest."""
    every = [row for title, found in seen.tables.items() if title.startswith("Model: ")
             for row in found]  # fmt: skip
    names = [row[0].partition(" (") for row in every]
    return {
        name: [poses.removesuffix(")"), *row[1:]]
        for (name, _, poses), row in zip(names, every, strict=True)
    }


def test_requirement_result_and_verdict(whole, tmp_path, capsys):
    fit, out = mc.load_fit(whole), tmp_path / "report.html"
    high = 1e3 * fit.within.rms.high
    for size, verdict in ((1.1 * high, "passed"), (0.5 * fit.within.after.rms_mm, "not passed")):
        told = ("report", whole, "--tolerance", f"rms {size:.6f}", "-o", out)
        assert run(*told) == 0
        stdout, stderr = capsys.readouterr()
        assert stdout.splitlines()[0] == verdict
        assert f"written: {out}" in stderr
        seen = Seen(out.read_text())
        poses, before, after, limit, asked, said = rows(seen)["RMS, inside measured region"]
        assert poses == f"{fit.within.after.poses} cross-validated"
        assert (before, after) == (f"{fit.within.before.rms_mm:.3f}",
                                   f"{fit.within.after.rms_mm:.3f}")  # fmt: skip
        assert (limit, asked, said) == (f"{high:.3f}", f"{size:.3g}", verdict)
        assert verdict.capitalize() in seen.text["verdict"]


def test_beyond_is_asked_of_the_worst_part(whole, tmp_path, capsys):
    fit = mc.load_fit(whole)
    out = tmp_path / "report.html"
    size = 0.5 * (fit.within.rms.high * 1e3 + fit.beyond.rms_high_mm)
    assert 1e3 * fit.within.rms.high < size < fit.beyond.rms_high_mm
    told = ("report", whole, "--tolerance", f"rms {size:.6f}", "-o", out, "-q")
    assert run(*told) == 0
    assert capsys.readouterr().out.startswith("passed")
    assert run(*told, "--tolerance-for", "outside") == 0
    assert capsys.readouterr().out.startswith("not passed")
    assert rows(Seen(out.read_text()))["RMS, outside, worst part"][-1] == "not passed"
    assert run(*told, "--tolerance-for", "above") == 2
    assert "choose inside or outside" in capsys.readouterr().err


def test_an_arm_of_half_its_lengths_is_not_signed_unseen(robot, tmp_path, capsys):
    """Points that are scaled by half give links of half their length: told on the sheet itself."""
    made = mc.simulate(robot, 60, seed=4)
    for factor, told in ((0.5, True), (1.0, False)):
        fit = mc.calibrate(robot, made.data.with_y(factor * made.data.y))
        fit.save(tmp_path / "fit.json")
        page = tmp_path / "report.html"
        assert run("report", tmp_path / "fit.json", "--tolerance", "rms 5", "-o", page, "-q") == 0
        said = capsys.readouterr().out
        assert said.startswith("not passed" if told else "passed")  # it has failed
        assert ("Implausibly large changes: a1 by" in said) == told
        assert ("another arm's" in Seen(page.read_text()).text["verdict"]) == told


def test_the_page_says_which_model_is_signed(results, whole):
    plain = rendered(WORDING, results / "fit.json", results / "gap.json")
    assert any(title == "Model: geometry alone" for title in plain.tables)
    text = plain.text["verdict"]
    assert "Signed is the calibration (geometry alone)" in text
    assert "What limits it now: gearboxes wind up under gravity" in text
    both = rendered(WORDING, whole, results / "gap.json")
    assert any(title == "Model: geometry, joint compliance" for title in both.tables)
    assert "Signed is the calibration" not in both.text["verdict"]
    # all that these data tell of the noise is that of the instrument
    assert "is the instrument's noise" in both.text["verdict"]
    # parameters of effects stand once: with the fit if it has them
    assert "parameters of the effects" in plain.tables
    assert "parameters of the effects" not in both.tables
    assert "effects beyond geometry" in both.tables


def test_only_what_a_diagnosis_establishes_is_told_for_established(results):
    fit, gap = mc.load_fit(results / "fit.json"), load_diagnosis(results / "gap.json")

    def limiting(verdict: str, share: float) -> str:
        found = tuple(replace(one, share=share) for one in gap.effects)
        told = Sources(fit, replace(gap, verdict=verdict, effects=found))
        return limits_now(told, signed(told, (), "inside", None))

    cause = "gearboxes wind up under gravity"
    assert limiting("named", 0.9).startswith(f"{cause} (joint compliance of the whole arm), which")
    for verdict in ("unknown", "not_repeatable"):
        guess = limiting(verdict, 0.9)
        assert "establishes" not in guess
        said = {"unknown": "Unexplained by the diagnosis: ", "not_repeatable": "Not repeatable: "}
        assert said[verdict] in guess
        assert guess.startswith(f"{cause} (")
    assert cause not in limiting("named", -0.001)  # a cause that closes nothing limits nothing


def test_a_floor_that_is_an_upper_bound_is_no_cause(results):
    gap = load_diagnosis(results / "gap.json")
    rest = replace(gap.remaining, unexplained_mm=0.026)
    sure = Floor(0.043, 0.04, 0.046, "the instrument")
    open_ = Floor(0.043, 0.0, 0.043, AT_MOST)
    assert (sure.certain, open_.certain) == (True, False)
    near = 0.05
    assert left_now(replace(gap, floor=sure), near) == (
        "measurement noise (0.043\N{NO-BREAK SPACE}mm)."
    )
    told = left_now(replace(gap, floor=open_, remaining=rest, floor_known=False), near)
    assert told.startswith("a remaining error that no known effect explains (")
    assert told.endswith("0.026 mm may be the arm's repeatability).")


def test_rungs_of_a_diagnosis(results, tmp_path):
    gap = load_diagnosis(results / "gap.json")
    for number, step in ((0, gap.ladder[0]), (1, gap.ladder[1]), (None, gap.ladder[-1])):
        wording = Wording("2026-11-21", rung=number)
        found = rows(rendered(wording, results / "gap.json"))["RMS, inside measured region"]
        assert found[0] == f"{step.holdout.poses} held out"
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
    wording = Wording("2026-11-21", limits=limits_of("max 5"))
    text = rendered(wording, tmp_path / "old.json").text["verdict"]
    assert "Not stated" in text
    assert "9 poses are too few for a maximum: at least 19 are needed" in text


def test_facts_are_of_the_file_or_to_be_filled_in(results, tmp_path, capsys):
    toml, out = tmp_path / "cell.toml", tmp_path / "report.html"
    toml.write_text('serial_number = "26-104711"\npayload = 12\ncustomer = "<b>Example</b>"\n')
    assert run("report", results / "fit.json", "--facts", toml, "-o", out) == 0
    text = out.read_text()
    assert "<dd>26-104711</dd>" in text
    assert "<dd>12</dd>" in text
    assert "&lt;b&gt;Example&lt;/b&gt;" in text
    assert text.count('class="blank"') == len(FACTS) - 2
    for content, words in (
        ('serial = "1"', "the key 'serial' is not known"),
        ("serial_number = ", "is not TOML"),
        ("[tool]\na = 1", "tool must be a text or a number"),
    ):
        toml.write_text(content)
        assert run("report", results / "fit.json", "--facts", toml, "-o", out) == 2
        assert words in capsys.readouterr().err


@pytest.mark.usefixtures("browser")
def test_paper_and_picture_by_the_ending(results, tmp_path, monkeypatch):
    assert run("report", results / "fit.json", "-o", tmp_path / "page.png") == 0
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")
    printed: list[tuple[str, Path]] = []  # by a browser in `test_pdf_holds_the_whole_report`
    monkeypatch.setattr(report, "print_pdf", lambda page, path, _: printed.append((page, path)))
    assert run("report", results / "fit.json", "-o", tmp_path / "page.pdf") == 0
    ((text, path),) = printed
    assert path == tmp_path / "page.pdf"
    assert "accuracy" in Seen(text).text

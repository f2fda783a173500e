"""A report: what it says stands in the files, and nothing of the files does anything in it."""

import base64
import copy
import gzip
import hashlib
import html
import json
import math
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from click.testing import CliRunner, Result
from conftest import SHARED, run, slipped
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from plotly.offline import get_plotlyjs

import minimax_cal as mc
from minimax_cal.cli.report import report_command
from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.tables import Table
from minimax_cal.modelling.effects.effect_names import format_budget_step, format_effect
from minimax_cal.modelling.simulate import simulate
from minimax_cal.reporting.html import (
    ChartBlock,
    ReportRequest,
    ReportSection,
    View3dBlock,
    browser_print,
    build_report,
    html_page,
    read_report_sources,
)
from minimax_cal.reporting.html.chart_parts import PALETTE_COLOUR_NAMES
from minimax_cal.reporting.html.error_charts import (
    build_box_trace,
    build_cumulative_error_chart,
    running_median,
)
from minimax_cal.reporting.html.html_page import format_script_json
from minimax_cal.reporting.html.report_content import escape_figure_label, select_drawn_indices
from minimax_cal.reporting.html.report_sources import ReportSources
from minimax_cal.reporting.html.workspace_svg import project_to_plane
from minimax_cal.reporting.html.workspace_view import (
    arm_polylines,
    build_drawn_workspace,
    choose_magnification,
    clip_tracker_to_workspace,
)
from minimax_cal.solvers.status import Status

SECTIONS = [
    "verdict", "budget", "where", "parameters", "accuracy", "joints", "correlations", "iso9283",
    "solution", "calibration-tables", "diagnosis-tables", "provenance",
]  # fmt: skip
PAGES = SECTIONS[:4]
NASTY = '<script>alert(1)</script>&amp;"\u2028</script><img src=x onerror=alert(2)>'
WORDING = ReportRequest("2026-11-21", author="A. Smith", customer="Example Ltd", appendix=True)


@pytest.fixture
def fit(results: Path) -> dict[str, Any]:
    """The calibration's JSON, to be changed."""
    out: dict[str, Any] = json.loads((results / "fit.json").read_text())
    return out


@pytest.fixture
def gap(results: Path) -> dict[str, Any]:
    """The diagnosis' JSON, to be changed."""
    out: dict[str, Any] = json.loads((results / "gap.json").read_text())
    return out


@pytest.fixture(scope="session")
def sources(results: Path) -> ReportSources:
    return read_report_sources([results / "fit.json", results / "gap.json"])


@pytest.fixture(scope="session")
def sections(sources: ReportSources) -> dict[str, ReportSection]:
    return {section.name: section for section in build_report(sources, WORDING).sections}


@pytest.fixture(scope="session")
def seen(sources: ReportSources) -> "Seen":
    return Seen(html_page.render_html(build_report(sources, WORDING)))


class Seen(HTMLParser):
    """What a page holds: tables by caption, text by section, scripts, attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.text: dict[str, str] = {}
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.tags: list[str] = []
        self.section = self.caption = ""
        self.cell: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag == "section":
            self.section = dict(attrs)["id"] or ""
            self.text[self.section] = ""
        if tag == "script":
            self.scripts.append((dict(attrs), ""))
        if tag in ("caption", "th", "td"):
            self.cell = []
        if tag == "tr":
            self.tables.setdefault(self.caption, []).append([])

    def handle_data(self, data: str) -> None:
        if self.tags[-1:] == ["script"] and self.scripts:
            attributes, text = self.scripts[-1]
            self.scripts[-1] = (attributes, text + data)
            return
        self.cell.append(data)
        if self.section:
            self.text[self.section] += data

    def handle_endtag(self, tag: str) -> None:
        if tag == "script":
            self.tags.append("")
        if tag == "caption":
            self.caption = "".join(self.cell)
        if tag in ("th", "td"):
            self.tables[self.caption][-1].append("".join(self.cell))


def command(*arguments: object) -> Result:
    """The command alone; errors of the user are raised."""
    return CliRunner().invoke(
        report_command, [str(a) for a in arguments], standalone_mode=False, catch_exceptions=False
    )


def write(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def rendered(tmp_path: Path, *contents: object) -> Seen:
    paths = [write(tmp_path / f"{i}.json", content) for i, content in enumerate(contents)]
    return Seen(html_page.render_html(build_report(read_report_sources(paths), WORDING)))


# ---- what it says ------------------------------------------------------------------------------


def test_every_section_is_there_in_order(seen):
    assert [name for name in seen.text if name != "signatures"] == SECTIONS
    assert seen.tags.count("h1") == 1
    assert seen.tags.count("h2") == len(SECTIONS) + 2  # signatures, contents


def test_four_pages_and_where_the_rest_is(sources):
    report = build_report(sources, replace(WORDING, appendix=False))
    seen = Seen(html_page.render_html(report))
    assert [name for name in seen.text if name != "signatures"] == PAGES
    assert all(section.sheet for section in report.sections)
    assert "its appendix, which has: How large the errors are; What" in seen.text[PAGES[-1]]


def test_nothing_is_lost_and_no_table_stands_twice(sources):
    """Every table of both results is on a page or in the appendix, once."""
    every = [b for part in build_report(sources, WORDING).sections for b in part.blocks]
    shown = [(b.title, b.formatted_cells()) for b in every if isinstance(b, Table)]
    for result in (sources.fit, sources.gap):
        for table in result.tables():
            assert shown.count((table.title, table.formatted_cells())) == 1, table.title
    assert len(shown) == len({title + str(cells) for title, cells in shown})


def table_of(seen: Seen, words: str) -> list[list[str]]:
    """The rows of the first table with words in its caption, the header first."""
    return next(rows for title, rows in seen.tables.items() if words in title)


def test_accuracy_is_that_of_the_calibration(results, seen):
    own = mc.calibrate("ur10", mc.read_measurements(results / "poses.csv")).accuracy_table()
    found = table_of(seen, "position accuracy")
    assert found == [list(own.header), *own.formatted_cells()]
    assert {"count", "RMS mm", "mean mm", "max mm", "smr1 RMS mm", "smr3 RMS mm"} <= set(found[0])
    crossed = ["cross-validated, nominal", "cross-validated, calibrated"]
    assert [row[0] for row in found[1:4]] == [*crossed, "held out, nominal"]


def test_parameters_are_those_of_the_file(fit, seen):
    rows = {row[0]: row for row in seen.tables["parameters"][1:]}
    titles = {p["name"]: f"{p['name']} (correction)" if "corrects" in p else p["name"]
              for p in fit["parameters"]}  # fmt: skip
    assert set(rows) == set(titles.values())
    for p in fit["parameters"]:
        turns = p["unit"] == "rad"
        scale, size = (1e3, 180.0 / np.pi) if turns else (1.0, 1.0)
        _, nominal, value, unit, change, sigma, of_change, reason = rows[titles[p["name"]]]
        assert of_change == ("mrad" if turns else "mm")
        if "corrects" in p:
            assert (nominal, value, unit) == ("-", "-", "")
        else:
            assert unit == ("deg" if turns else "mm")
            shown = (f"{size * p[key]:.4f}" for key in ("nominal", "value"))
            assert (nominal, value) == tuple("0.0000" if s == "-0.0000" else s for s in shown)
        assert change == f"{scale * (p['value'] - p['nominal']):+.4f}"
        assert sigma == ("-" if p["sigma"] is None else f"{scale * p['sigma']:.2g}")
        assert reason == ("" if p["identifiable"] else p["reason"])


def test_diagnosis_is_that_of_the_file(gap, seen):
    for reason in gap["reasons"]:
        places = sum(reason in seen.text[page] for page in ("verdict", "budget"))
        assert places == (0 if reason.startswith("Outside") else 1), reason  # once, of the file
    ladder = table_of(seen, ": error budget, step by step")[1:]
    assert [row[0] for row in ladder[:-1]] == [
        format_budget_step(r["step"]) for r in gap["gap"]["ladder"]
    ]
    for row, rung in zip(ladder, gap["gap"]["ladder"], strict=False):
        numbers = [rung[p][k] for p in ("train", "holdout") for k in ("rms_mm", "max_mm")]
        assert row[1:] == [f"{value:.4f}" for value in numbers]
    assert ladder[-1][1] == f"{gap['gap']['noise_floor_mm']:.4f}"
    effects = table_of(seen, "effects found")[1:]
    assert [row[0] for row in effects] == [
        format_effect(e["effect"], e["place"]) for e in gap["effects"]
    ]
    assert [row[3:5] for row in effects] == [
        [f"{e['holdout_rms_mm'][k]:.4f}" for k in ("before", "after")] for e in gap["effects"]
    ]
    regions = seen.tables["error after geometry, by region"][1:]
    assert [row[-1] for row in regions] == [
        f"{cell['rms_mm']:.4f}" for cell in gap["where"]["by_region"]["cells"]
    ]


def test_solution_names_the_backend_of_every_step(fit, seen):
    steps = seen.tables["Steps of the minimax"][1:]
    assert [(row[0], row[-1]) for row in steps] == [
        (str(s["iteration"]), s["backend"]) for s in fit["minimax"]["trace"]
    ]
    multipliers = table_of(seen, "what the worst error")[1:]
    assert sum(float(row[2]) for row in multipliers) == pytest.approx(1.0, abs=2e-4)  # rounding
    assert [row[0] for row in multipliers] == fit["minimax"]["functions"]


def test_accuracy_states_the_held_out_numbers(fit, seen):
    rms, largest, *_ = table_of(seen, "Model: geometry alone")[1:]
    crossed = mc.Fit.from_dict(fit).within
    for row, key in ((rms, "rms_mm"), (largest, "max_mm")):
        assert row[2] == f"{getattr(crossed.before, key):.3f}"
        assert row[3] == f"{getattr(crossed.after, key):.3f}"
    assert rms[4] == f"{1e3 * crossed.rms.low:.3f} to {1e3 * crossed.rms.high:.3f}"


def test_provenance_has_the_digests_of_the_files(results, seen):
    files = {row[0]: row[1:] for row in seen.tables["Files"][1:]}
    for kind, name in (("calibration", "fit.json"), ("diagnosis", "gap.json"),
                       ("measurements", "poses.csv")):  # fmt: skip
        raw = (results / name).read_bytes()
        assert files[kind] == [name, hashlib.sha256(raw).hexdigest()]
    chosen = dict(seen.tables["Settings of the calibration"][1:])
    assert chosen["seed"] == "0"
    assert chosen["holdout"] == "0.2"


def test_iso_values_are_there_with_their_caveat(seen):
    assert "not a test by the standard" in seen.text["iso9283"]
    assert any("AP" in title and "7.2" in title for title in seen.tables)


def test_what_later_files_tell_is_shown(tmp_path, fit, gap):
    for part in ("nominal", "nominal_train"):
        fit["accuracy"][part].pop("rms_ci95_mm", None)
    fit["accuracy"]["holdout"] |= {"rms_ci95_mm": [0.111, 0.222], "max_ci95_mm": [0.222, None]}
    fit["covariance"] |= {
        "names": ["a1", "theta2"], "units": ["mm", "rad"], "rows": [[4.0, 3.0], [3.0, 9.0]]
    }  # fmt: skip
    fit["suspects"] = [
        {"line": 7, "target": "smr2", "distance_mm": 1.5, "score": 9.25,
         "chance": 1e-9, "together": False, "held": False}
    ]  # fmt: skip
    seen = rendered(tmp_path, fit, gap)
    (row,) = table_of(seen, "95 % intervals")[1:]  # the file does not tell the nominal robot's
    assert [row[0], *row[2:4], *row[5:]] == ["calibrated", "0.1110", "0.2220", "0.2220", "-"]
    assert seen.tables["Strongest correlations"][1] == ["a1", "theta2", "+0.500"]
    assert seen.tables["outliers (1 % of the list are false alarms; they may be real effects)"][1][
        :4
    ] == ["line 7", "smr2", "1.5000", "9.2"]


@pytest.mark.parametrize(
    ("given", "lacking"), [("fit.json", "diagnosis-tables"), ("gap.json", "solution")]
)
def test_no_chapter_is_empty(results, given, lacking):
    seen = Seen(
        html_page.render_html(build_report(read_report_sources([results / given]), WORDING))
    )
    told = [name for name in seen.text if name != "signatures"]
    assert told == [name for name in SECTIONS if name in told]
    assert lacking not in told
    assert {"accuracy", *PAGES} < set(told)


def test_files_without_poses_give_their_tables(tmp_path, fit, gap):
    for key in ("poses", "minimax"):
        del fit[key]
    for key in ("poses", "curves"):
        del gap[key]
    seen = rendered(tmp_path, fit, gap)
    assert "holds no poses" in seen.text["where"]
    assert not {"accuracy", "joints", "iso9283"} & set(seen.text)
    assert len(seen.tables["parameters"]) > 30


def test_a_fit_that_did_not_converge_warns(tmp_path, fit):
    fit |= {"status": "iteration_limit"}
    fit["accuracy"]["holdout"] = fit["accuracy"]["nominal"]
    text = rendered(tmp_path, fit).text["verdict"]
    assert f"did not converge (iteration limit): {Status.ITERATION_LIMIT.advice}." in text
    assert "the calibration is no improvement" in text


def test_nothing_held_out_is_said(tmp_path, results):
    data = mc.read_measurements(results / "poses.csv")
    mc.calibrate("ur10", data, holdout=0.0).save(tmp_path / "all.json")
    seen = Seen(
        html_page.render_html(build_report(read_report_sources([tmp_path / "all.json"]), WORDING))
    )
    assert "No pose was held out" in seen.text["verdict"]


# ---- the numbers of the figures ----------------------------------------------------------------


def figures(sections: dict[str, ReportSection]) -> list[ChartBlock]:
    return [b for section in sections.values() for b in section.blocks if isinstance(b, ChartBlock)]


def painted(value: Any, key: str = "") -> Any:
    """Names of colours as colours, as the page's script has them."""
    if isinstance(value, dict):
        return {name: painted(part, name) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [painted(part, key) for part in value]
    is_colour = isinstance(value, str) and key.endswith(("color", "colorscale"))
    return "#123456" if is_colour and value in PALETTE_COLOUR_NAMES else value


def test_figures_are_what_plotly_understands(sections):
    found = figures(sections)
    assert len(found) >= 8
    assert len({figure.name for figure in found}) == len(found)
    for figure in found:
        go.Figure(painted(figure.traces), painted(figure.layout))  # raises for a slip
        assert figure.says
        assert all(len(t["x"]) == len(t["y"]) for t in figure.traces if t["type"] == "scatter")


def test_distributions_are_those_of_the_points(sources):
    poses = sources.poses
    held = np.linalg.norm(poses.after, axis=-1)[poses.held]
    curve = build_cumulative_error_chart(poses, ("nominal", "calibrated")).traces[1]
    for x, y in zip(curve["x"], curve["y"], strict=True):
        assert 100.0 * (held <= x * (1 + 1e-5)).mean() == pytest.approx(y, abs=1e-4)
    assert curve["x"][-1] == pytest.approx(held.max(), rel=1e-5)


def test_boxes_are_quartiles(rng):
    values = rng.exponential(size=(2, 40))
    values[0, 3] = np.nan
    values = np.vstack([values, np.full(40, np.nan)])  # a target that was never seen
    drawn = build_box_trace("after", "calibrated", ["one", "two", "three"], values.T, panel_index=0)
    assert drawn["x"] == ["one", "two"]
    parts = [drawn[key] for key in ("lowerfence", "q1", "median", "q3", "upperfence")]
    assert_allclose(parts, np.nanpercentile(values[:2], [0, 25, 50, 75, 100], axis=1), rtol=1e-5)


# ---- the workspace -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["irb2600", "ur10", "irb120"])
def test_the_arm_ends_at_the_flange(name, rng):
    robot = mc.load_robot(name)
    q = rng.uniform(-2, 2, size=(7, robot.joints))
    arm, corners = arm_polylines(robot, q)
    assert_allclose(arm[:, 0], 0.0)
    assert_allclose(arm[:, -1], 1e3 * robot.pose(q)[:, :3, 3], atol=1e-9)
    lengths = np.linalg.norm(np.diff(arm, axis=1), axis=-1)
    assert_allclose(lengths, lengths[:1].repeat(7, axis=0), atol=1e-9)  # links are rigid
    parts = 1e3 * np.abs(robot.mdh[:, [1, 0]]).ravel()  # d along the axis, then a
    assert_allclose(lengths[0], parts[parts > 1e-6], atol=1e-9)
    assert corners[0]
    assert corners[-1]


def test_arrows_lead_from_prediction_to_measurement(sources):
    poses, cell = sources.poses, sources.cell
    space = build_drawn_workspace(poses, cell)
    predicted = space.points - space.after
    flange = cell.robot.pose(poses.data.q[space.pose_indices])
    spots = (
        np.einsum("mij,kj->mki", flange[:, :3, :3], cell.target_positions) + flange[:, None, :3, 3]
    )
    assert_allclose(predicted, 1e3 * spots, atol=1e-6)
    tracker = np.linalg.solve(cell.base, [0, 0, 0, 1])[:3]  # origin of the measurement frame
    assert space.tracker_distance == pytest.approx(1e3 * np.linalg.norm(tracker))
    off = np.cross(space.tracker - space.centre, 1e3 * tracker - space.centre)
    assert_allclose(off / space.radius**2, 0.0, atol=1e-9)  # in the true direction
    assert np.all(
        np.abs(clip_tracker_to_workspace(space) - space.centre)
        <= 0.8 * (space.high - space.low) + 1e3
    )
    times = choose_magnification(space, space.after)
    sizes = times * np.linalg.norm(space.after, axis=-1)
    assert 0.03 < np.percentile(sizes, 90) / space.radius < 0.13


def test_view_holds_every_arrow_once(sections, fit):
    view = next(b for b in sections["where"].blocks if isinstance(b, View3dBlock))
    rows = fit["poses"]["measured_mm"]
    count = sum(spot[0] is not None for pose in rows for spot in pose)
    for key in ("points", "before", "after"):
        assert len(view.arms[key]) == 3 * count
    told = np.reshape(view.arms["after"], (-1, 3))
    real = np.array(fit["poses"]["errors_mm"]["final"]).reshape(-1, 3)
    assert_allclose(np.sort(np.linalg.norm(told, axis=1)), np.sort(np.linalg.norm(real, axis=1)),
                    rtol=2e-3)  # fmt: skip
    assert view.still.startswith("<svg")
    assert f"magnified {view.arms['start'][1]} times" in view.still


def test_many_poses_are_capped_and_that_is_said(tmp_path):
    made = simulate(mc.load_robot("ur10"), 700, 1, seed=2)
    mc.calibrate("ur10", made.data).save(tmp_path / "many.json")
    report = build_report(read_report_sources([tmp_path / "many.json"]), WORDING)
    found = {f.name: f for f in figures({s.name: s for s in report.sections})}
    for name in ("workspace", "joints", "order"):
        assert "500 of 700 poses are drawn" in found[name].says
    drawn = sum(len(t["x"]) for t in found["order"].traces if t["mode"] == "markers")
    assert drawn == 2 * 500
    assert len(html_page.render_html(report)) < 4e6


# ---- nothing but text --------------------------------------------------------------------------


def hostile(content: dict[str, Any]) -> dict[str, Any]:
    """The same file with every name of another's choice."""
    old, new = "smr2", NASTY

    def renamed(value: Any) -> Any:
        if isinstance(value, dict):
            return {renamed(key): renamed(part) for key, part in value.items()}
        if isinstance(value, list):
            return [renamed(part) for part in value]
        return (
            re.sub(f"^{old}(?=$|_[xyz]$)", lambda _: new, value)
            if isinstance(value, str)
            else value
        )

    out: dict[str, Any] = renamed(copy.deepcopy(content))
    for robot in (out.get("robot"), out.get("nominal_robot"), *[
        cell["robot"] for cell in out.get("cells", [])
    ]):  # fmt: skip
        if isinstance(robot, dict):
            robot["name"] = NASTY
    if isinstance(out["robot"], str):
        out["robot"] = NASTY
    out["provenance"] |= {"data": NASTY, "settings": {NASTY: NASTY}, "versions": {NASTY: NASTY}}
    out["notices"] = [NASTY]
    return out


def test_hostile_names_are_text(tmp_path, fit, gap):
    fit, gap = hostile(fit), hostile(gap)
    for curve in gap["curves"].values():
        curve["title"] = curve["x"]["label"] = curve["views"][0]["name"] = NASTY
    gap["effects"][0]["parameters"][0]["name"] = NASTY
    gap["not_testable"] = [{"effect": NASTY, "needs": NASTY}]
    gap["verdict"], gap["structure"] = "unknown", {"p": 1e-9, "in": NASTY}
    fit["parameters"][0]["reason"] = fit["objective"] = fit["qp"] = NASTY
    fit["parameters"][0]["identifiable"] = False
    fit["minimax"]["trace"][0]["backend"] = NASTY
    seen = rendered(tmp_path, fit, gap)
    plain = Seen(
        html_page.render_html(build_report(read_report_sources([tmp_path / "0.json"]), WORDING))
    )
    assert "img" not in seen.tags
    assert not [name for _, name, _ in seen.attributes if name.startswith("on")]
    kinds = [attributes.get("type") for attributes, _ in seen.scripts]
    assert kinds.count("application/json") == len(kinds) - 2  # figures, plotly, the page's own
    assert kinds.count(None) == plain.tags.count("body") == 1
    text = replace_invisible_and_bidi_characters(NASTY)
    for name in ("verdict", "provenance", "diagnosis-tables", "solution", "parameters"):
        assert text in seen.text[name]
    assert seen.tables["Files"][2][1] == text


def test_labels_of_figures_hold_no_marks(tmp_path, fit, gap):
    paths = [write(tmp_path / "0.json", hostile(fit)), write(tmp_path / "1.json", hostile(gap))]
    report = build_report(read_report_sources(paths), WORDING)

    def texts(value: Any) -> list[str]:
        if isinstance(value, dict):
            return [t for key, part in value.items() for t in texts(part)
                    if key not in ("legendgroup", "offsetgroup", "hovertemplate")]  # fmt: skip
        if isinstance(value, list | tuple):
            return [t for part in value for t in texts(part)]
        return [value] if isinstance(value, str) else []

    for figure in figures({s.name: s for s in report.sections}):
        for text in texts([figure.traces, figure.layout]):
            assert not re.search(r"<(?!br>)|>(?<!<br>)", text), text


@given(st.text(max_size=60))
@settings(max_examples=50)
def test_label_comes_back_from_its_marks(text):
    assert html.unescape(escape_figure_label(text)) == html.unescape(html.escape(text, quote=False))
    assert not {"<", ">"} & set(escape_figure_label(text))
    assert len(html.unescape(escape_figure_label(text * 50))) <= 70


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda parts: st.lists(parts, max_size=4) | st.dictionaries(st.text(), parts, max_size=4),
    max_leaves=8,
)  # fmt: skip


@given(JSON)
def test_json_in_a_script_cannot_end_it(content):
    text = format_script_json(content)
    assert json.loads(text) == content
    assert not set("<>&\u2028\u2029") & set(text)


@given(st.text())
@settings(max_examples=200)
def test_what_is_shown_can_be_written_and_hides_nothing(text):
    shown = replace_invisible_and_bidi_characters(text)
    shown.encode()  # no lone surrogates
    assert len(shown) == len(text)
    assert replace_invisible_and_bidi_characters(shown) == shown
    assert not set("\u202e\u2066\x00\x1b\n") & set(shown)


def test_nothing_leads_outside(seen, sources):
    text = html_page.render_html(build_report(sources, WORDING))
    clear = re.sub(r'(id="plotly">)[A-Za-z0-9+/=]+', r"\1", text)
    assert len(clear) < 0.4 * len(text)
    for word in ("http:", "https:", "://", "url(",
                 "@import", "fetch(", "XMLHttpRequest", "WebSocket",
                 "sendBeacon", "import("):  # fmt: skip
        assert word not in clear, word
    for tag, name, value in seen.attributes:
        assert name not in ("src", "srcset", "action", "formaction", "ping", "background"), tag
        assert name != "href" or value.startswith("#")
    anchors = {value for _, name, value in seen.attributes if name == "id"}
    links = {value[1:] for _, name, value in seen.attributes if name == "href"}
    assert links <= anchors
    assert links >= set(SECTIONS) - {"verdict"}


def test_policy_allows_two_scripts_and_no_request(seen):
    equivalents = [v for tag, name, v in seen.attributes if (tag, name) == ("meta", "content")]
    policy = next(v for v in equivalents if v.startswith("default-src 'none'"))
    parts = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert "unsafe" not in parts["script-src"]
    assert parts["img-src"] == "data: blob:"
    assert not {"connect-src", "frame-src", "worker-src"} & set(parts)
    library = next(t for a, t in seen.scripts if a.get("id") == "plotly")
    unpacked = gzip.decompress(base64.b64decode(library)).decode()
    assert unpacked == get_plotlyjs()
    own = next(text for attributes, text in seen.scripts if not attributes)
    for script in (own, unpacked):
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in parts["script-src"]


def test_tables_and_figures_have_words_for_everyone(seen):
    assert ("html", "lang", "en") in seen.attributes
    assert seen.tags.count("caption") == seen.tags.count("table")
    scopes = [value for tag, name, value in seen.attributes if (tag, name) == ("th", "scope")]
    assert len(scopes) == seen.tags.count("th")
    labels = [v for tag, name, v in seen.attributes if (tag, name) == ("div", "aria-label")]
    assert all(labels)
    roles = [v for tag, name, v in seen.attributes if (tag, name) == ("div", "role")]
    assert roles.count("img") == seen.tags.count("figure")


# ---- the command -------------------------------------------------------------------------------


def test_the_same_files_give_the_same_page(results, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    files = (results / "fit.json", results / "gap.json")
    for name in ("a.html", "b.html"):
        assert command(*files, "-o", tmp_path / name).return_value == 0
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert "1970-01-02" in (tmp_path / "a.html").read_text()
    command(*files, "-o", tmp_path / "a.html", "--date", "2026-01-31", "--title", "For <Bob>")
    text = (tmp_path / "a.html").read_text()
    assert "2026-01-31" in text
    assert "<h1>For &lt;Bob&gt;</h1>" in text
    for day, word in (("yesterday", "2026-01-31"), ("", "SOURCE_DATE_EPOCH")):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", "soon")
        with pytest.raises(OptionError, match=word):
            command(*files, "-o", tmp_path / "c.html", "--date", day)
    assert not (tmp_path / "c.html").exists()


def test_files_must_belong_together(results, tmp_path, fit, gap):
    one, other = results / "fit.json", results / "gap.json"
    with pytest.raises(CalibrationError, match="second calibration"):
        read_report_sources([one, one])
    with pytest.raises(CalibrationError, match="second calibration"):
        read_report_sources([one, other, one])
    with pytest.raises(CalibrationError, match="one to three files"):
        read_report_sources([])
    with pytest.raises(CalibrationError, match="neither a calibration nor a diagnosis"):
        read_report_sources([write(tmp_path / "a.json", {"kind": "evaluation"})])
    changed = copy.deepcopy(gap)
    changed["provenance"]["data_sha256"] = "0" * 64
    with pytest.raises(CalibrationError, match="different measurements"):
        read_report_sources([one, write(tmp_path / "a.json", changed)])
    assert read_report_sources([other, one]).notices == ()
    gap["poses"]["split"] = gap["poses"]["split"][::-1]
    gap["robot"] = "another"
    told = read_report_sources([one, write(tmp_path / "a.json", gap)]).notices
    assert len(told) == 2
    assert "another" in told[0]
    assert "held out different poses" in told[1]


BROKEN: dict[str, Callable[[dict[str, Any]], object]] = {
    "no parameters": lambda c: c.pop("parameters"),
    "text for a number": lambda c: c["accuracy"]["train"].update(rms_mm="much"),
    "targets differ": lambda c: c["accuracy"]["train"].update(sse_mm2=[1.0]),
    "no robot": lambda c: c.pop("robot"),
    "poses are cut": lambda c: c["poses"].update(q=c["poses"]["q"][:5]),
    "errors are cut": lambda c: c["poses"]["errors_mm"].update(final=[]),
    "no errors": lambda c: c["poses"].pop("errors_mm"),
    "poses of another arm": lambda c: c["poses"].update(
        q=[[0.0]] * len(c["poses"]["q"]), q_units=["rad"]
    ),
    "covariance without rows": lambda c: c.update(covariance={"names": ["a"], "rows": []}),
    "multipliers are cut": lambda c: c["minimax"].update(multipliers=[]),
    "schema of the future": lambda c: c.update(schema=2),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_file_is_one_line(how, tmp_path, fit, says):
    BROKEN[how](fit)
    path = write(tmp_path / "fit.json", fit)
    out, err = says("report", path, "-o", tmp_path / "report.html", code=2)
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith(f"error: {path}: ")
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "NaN", '{"a": NaN}', "[" * 100_000, "\xff", "7" * 5000]
)
def test_what_is_no_json_is_said(text, tmp_path, says):
    path = tmp_path / "fit.json"
    path.write_bytes(text.encode("latin-1"))
    assert says("report", path, "-o", tmp_path / "report.html", code=2).err.count("\n") == 1


@pytest.mark.parametrize("slips", [20, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["fit.json", "gap.json"])
def test_no_slip_in_a_file_is_a_traceback(name, slips, results, tmp_path):
    rng = np.random.default_rng(1)
    whole = json.loads((results / name).read_text())
    odd = [None, "x", -1, 1e30, [], {}, [None], True]
    for _ in range(slips):
        path = write(tmp_path / "slip.json", slipped(whole, rng, odd, 0.0))
        with suppress(CalibrationError):
            build_report(read_report_sources([path]), WORDING)


def test_what_is_not_installed_is_said(sources, monkeypatch, tmp_path, results):
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(OptionError, match=r"none was found; .* print it"):
        command(results / "fit.json", "-o", tmp_path / "a.html", "--pdf", tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []  # before any work
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(OptionError, match=r"in a clone of the repository"):
        html_page.render_html(build_report(sources, WORDING))


def test_a_browser_that_fails_leaves_no_pdf(tmp_path):
    with pytest.raises(CalibrationError, match="could not print it"):
        browser_print.write_pdf("<p>", tmp_path / "a.pdf", "/bin/false")
    assert list(tmp_path.iterdir()) == []


def test_paths_are_checked_first(results, tmp_path):
    for options in (("-o", "a.txt"), ("-o", tmp_path / "none" / "a.html"), ("--pdf", "a.html")):
        with pytest.raises(CalibrationError):
            command(results / "fit.json", *options)


@pytest.mark.slow
def test_real_arm_in_three_commands(tmp_path, capsys):
    folder = SHARED / "irb120"
    if not folder.is_dir():
        pytest.skip(f"real measurements {folder} are not on this machine")
    lines = (folder / "measurements.csv").read_text().splitlines()[:81]  # 80 poses do
    data, robot = tmp_path / "poses.csv", folder / "robot.json"
    data.write_text("\n".join(lines) + "\n")
    fit, gap, out = (tmp_path / name for name in ("fit.json", "gap.json", "report.html"))
    assert run("calibrate", robot, data, "-o", fit, "-q") == 0
    assert run("diagnose", robot, data, "-o", gap, "-q", "--quick") == 0
    assert run("report", fit, gap, "-o", out, "--appendix") == 0
    seen = Seen(out.read_text())
    told = json.loads(fit.read_text())["accuracy"]["holdout"]
    assert math.isfinite(told["rms_mm"])
    shown = json.loads(fit.read_text())["accuracy"].get("cv", told)  # few poses are held out
    assert f"{shown['rms_mm']:.3f}" in seen.text["verdict"]
    assert hashlib.sha256(data.read_bytes()).hexdigest() in seen.text["provenance"]
    assert list(seen.text) == [SECTIONS[0], "signatures", *SECTIONS[1:]]


def test_trend_is_a_running_median():
    x = np.arange(60.0)[::-1]
    at, middle = running_median(x, 3.0 * x)
    assert len(at) == 12
    assert_allclose(middle, 3.0 * at)
    assert np.all(np.diff(at) > 0)


def test_still_is_a_parallel_projection():
    right, up, depth = (
        project_to_plane(np.eye(3)).T[0],
        -project_to_plane(np.eye(3)).T[1],
        np.zeros(3),
    )
    depth = np.cross(right, up)
    assert_allclose(np.stack([right, up, depth]) @ np.stack([right, up, depth]).T, np.eye(3),
                    atol=1e-12)  # fmt: skip
    assert up[2] > 0.5  # z stays upright


@given(st.lists(st.floats(0, 1e3), max_size=60), st.integers(4, 20))
def test_some_keeps_the_largest(size, most):
    chosen = select_drawn_indices(np.array(size), most)
    assert len(chosen) == min(most, len(size))
    assert np.all(np.diff(chosen) > 0)
    if size:
        assert max(size) == max(size[i] for i in chosen)

"""A report in a real browser: everything is drawn, nothing is sent, names do nothing."""

import io
import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import run
from test_report import NASTY, WORDING, hostile, write

from experiments.relative_gap import RelativeGapJob, draw_arm, simulate_instrument
from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.tables import Table
from minimax_cal.diagnosing.diagnose_instruments import diagnose_relative
from minimax_cal.reporting.html import build_report, read_report_sources, render_html
from minimax_cal.reporting.html.report_content import ChartBlock
from minimax_cal.validation.tolerance import parse_tolerance_limits

A4 = (680, 993)  # pixels between the margins
PATIENCE = 120.0  # seconds; drawing by software on a busy machine is slow


@pytest.fixture(scope="module")
def folder(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Reports of good files and of hostile ones."""
    out = tmp_path_factory.mktemp("pages")
    files = [results / name for name in ("fit.json", "gap.json")]
    bad = [write(out / path.name, hostile(json.loads(path.read_text()))) for path in files]
    for name, paths in (("good", files), ("bad", bad)):
        (out / f"{name}.html").write_text(
            render_html(build_report(read_report_sources(paths), WORDING))
        )
    return out


@pytest.fixture(scope="module")
def opened(driver: Any, folder: Path) -> Any:
    """The browser with the good report, drawn; logs are of this page alone."""
    open_page(driver, folder / "good.html")
    return driver


def open_page(driver: Any, path: Path) -> None:
    for kind in ("browser", "performance"):
        driver.get_log(kind)
    driver.get(path.as_uri())
    end = time.monotonic() + PATIENCE
    while not driver.execute_script("return document.body.dataset.drawn"):
        assert time.monotonic() < end, "the charts were not drawn in time"
        time.sleep(0.1)


def colour(driver: Any, selector: str, key: str) -> tuple[int, ...]:
    script = "return getComputedStyle(document.querySelector(arguments[0]))[arguments[1]]"
    text = driver.execute_script(script, selector, key)
    return tuple(map(int, re.findall(r"\d+", text)[:3]))


def scheme(driver: Any, name: str, media: str = "") -> None:
    feature = {"name": "prefers-color-scheme", "value": name}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": [feature]})


def sent(driver: Any) -> list[str]:
    """Addresses that the page asked for."""
    events = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    return [
        event["params"]["request"]["url"]
        for event in events
        if event["method"] == "Network.requestWillBeSent"
    ]


@pytest.mark.dev
def test_opens_without_a_complaint_and_asks_for_nothing(opened, folder):
    assert opened.execute_script("return document.body.dataset.drawn") == "yes"
    assert [e for e in opened.get_log("browser") if e["level"] == "SEVERE"] == []
    asked = sent(opened)
    assert asked[0] == (folder / "good.html").as_uri()
    assert not [url for url in asked[1:] if not url.startswith(("data:", "blob:"))]


@pytest.mark.dev
def test_every_section_shows_the_numbers_of_the_files(opened, results):
    files = [results / name for name in ("fit.json", "gap.json")]
    for section in build_report(read_report_sources(files), WORDING).sections:
        rows = opened.execute_script(
            "return [...document.getElementById(arguments[0]).querySelectorAll('table')].map(t => "
            "[t.caption.textContent, [...t.rows].map(r => [...r.cells].map(c => c.textContent))])",
            section.name,
        )
        own = [block for block in section.blocks if isinstance(block, Table)]
        assert rows == [[t.title, [list(t.header), *t.formatted_cells()]] for t in own]


@pytest.mark.dev
def test_every_chart_is_drawn(opened, results):
    files = [results / name for name in ("fit.json", "gap.json")]
    report = build_report(read_report_sources(files), WORDING)
    names = [b.name for s in report.sections for b in s.blocks if isinstance(b, ChartBlock)]
    assert len(names) >= 8
    for name in names:
        marks, wide = opened.execute_script(
            "const e = document.getElementById('chart-' + arguments[0]);"
            "return [e.querySelectorAll('.main-svg path[d]').length, e.offsetWidth]",
            name,
        )
        assert marks > 0, name
        assert wide > 600, name
    assert opened.execute_script("return document.querySelectorAll('.waiting').length") == 0


@pytest.mark.dev
def test_the_view_in_space_is_not_empty(opened):
    image = pytest.importorskip("PIL.Image", reason="pillow reads the screenshot")
    chart = opened.find_element("id", "chart-workspace")
    scheme(opened, "light")
    before = np.asarray(image.open(io.BytesIO(chart.screenshot_as_png)).convert("RGB"), dtype=int)
    blue = (before[..., 2] - before[..., 0]) > 60
    assert blue.sum() > 300  # the arrows
    choice = opened.find_element("css selector", "input[name=shown][value='0']")
    opened.execute_script("arguments[0].focus()", choice)
    choice.send_keys(" ")
    time.sleep(1.0)
    after = np.asarray(image.open(io.BytesIO(chart.screenshot_as_png)).convert("RGB"), dtype=int)
    red = (after[..., 0] - after[..., 2]) > 60
    assert red.sum() > 300  # those of the nominal robot instead
    opened.find_element("css selector", "input[name=shown][value='1']").send_keys(" ")


@pytest.mark.dev
def test_controls_work_by_keyboard(opened):
    keys = pytest.importorskip("selenium.webdriver.common.keys").Keys
    for name in ("times", "pose"):
        told = opened.find_element("id", f"{name}-told")
        before = told.text
        opened.find_element("id", name).send_keys(keys.ARROW_LEFT)
        assert told.text != before
    assert re.fullmatch(
        "\N{MULTIPLICATION SIGN} [125]0*", opened.find_element("id", "times-told").text
    )
    line = r"line \d+ \((held out|training)\): nominal [\d.]+ mm, calibrated [\d.]+ mm"
    assert re.fullmatch(line, opened.find_element("id", "pose-told").text)
    drawn = opened.execute_script(
        "return document.getElementById('chart-workspace').data.map(t => t.x.length)"
    )
    assert drawn[0] == 0  # only the errors asked for
    assert drawn[1] > 100


@pytest.mark.dev
def test_dark_and_light_follow_system_and_button(opened):
    keys = pytest.importorskip("selenium.webdriver.common.keys").Keys

    def state() -> tuple[bool, bool]:
        time.sleep(0.5)
        text = ".chart .main-svg text"
        return sum(colour(opened, "body", "backgroundColor")) < 200, (
            sum(colour(opened, text, "fill")) > 500
        )

    scheme(opened, "dark")
    assert state() == (True, True)
    scheme(opened, "light")
    assert state() == (False, False)
    button = opened.find_element("id", "theme")
    button.send_keys(keys.ENTER)
    assert state() == (True, True)
    assert button.get_attribute("aria-pressed") == "true"
    button.send_keys(keys.ENTER)
    assert state() == (False, False)
    opened.execute_script("delete document.documentElement.dataset.theme")


@pytest.mark.dev
def test_paper_is_light_and_shows_the_still_view(opened):
    shown = "return getComputedStyle(document.querySelector(arguments[0])).display"
    scheme(opened, "dark", "print")
    opened.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    assert sum(colour(opened, "body", "backgroundColor")) == 3 * 255
    assert sum(colour(opened, ".chart .main-svg text", "fill")) < 200
    assert opened.execute_script(shown, ".view .flat") == "block"
    assert opened.execute_script(shown, ".view .live") == "none"
    assert opened.execute_script(shown, "#theme") == "none"
    wide = opened.execute_script(
        "return [...document.querySelectorAll('.chart:not(#chart-workspace) .main-svg')]"
        ".map(s => Number(s.getAttribute('width')))"
    )
    assert set(wide) == {680}
    opened.execute_script("window.dispatchEvent(new Event('afterprint'))")
    scheme(opened, "light")
    assert opened.execute_script(shown, ".view .flat") == "none"


@pytest.mark.dev
def test_narrow_pages_scroll_in_their_tables_alone(opened):
    """As wide as a phone, light and dark: nothing stands out of the page."""
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    time.sleep(0.5)
    wide = "return [document.documentElement.scrollWidth, innerWidth]"
    width, room = opened.execute_script(wide)
    button = "const b = document.getElementById('theme').getBoundingClientRect(),"
    button += " h = document.querySelector('h1').getBoundingClientRect();"
    clear = opened.execute_script(button + "return b.bottom <= h.top || b.left >= h.right")
    opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert width <= room
    assert clear


@pytest.mark.dev
def test_the_page_itself_forbids_scripts_and_requests(opened):
    found = opened.execute_async_script(
        """
        const done = arguments[arguments.length - 1], broken = [];
        document.addEventListener("securitypolicyviolation", (e) =>
          broken.push(e.effectiveDirective));
        const script = document.createElement("script");
        script.textContent = "window.intruder = 1";
        document.body.append(script);
        new Image().src = "http://127.0.0.1:9/x.png";
        fetch("http://127.0.0.1:9/").catch(() => {}).finally(() =>
          setTimeout(() => done([window.intruder ?? 0, broken]), 200));
        """
    )
    assert found[0] == 0
    assert set(found[1]) == {"script-src-elem", "img-src", "connect-src"}
    opened.get_log("browser")


@pytest.mark.dev
def test_the_first_page_is_one_sheet_with_all_that_is_signed(driver, results, tmp_path):
    """On A4: robot, verdict, cause, results, picture and signatures, and nothing else."""
    limits = parse_tolerance_limits("rms 0.2, max 0.5")
    facts = {"serial_number": "26-104711", "tool": "three-ball nest, " * 4}
    wording = replace(WORDING, limits=limits, facts=facts)
    sources = read_report_sources([results / "fit.json", results / "gap.json"])
    path = tmp_path / "page.html"
    path.write_text(render_html(build_report(sources, wording)))
    open_page(driver, path)
    size = {"width": A4[0], "height": A4[1], "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme(driver, "light", "print")
    box = driver.execute_script(
        "const b = document.getElementById('first').getBoundingClientRect();"
        "return [b.width, b.height]"
    )
    text = driver.execute_script("return document.getElementById('first').innerText")
    scheme(driver, "light")
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert box[1] < A4[1]
    for word in (sources.robot, "26-104711", "required", "0.2", "Not passed",
                 "Main cause", "signature", "Checked", "A. Smith"):  # fmt: skip
        assert word in text, word
    assert "Contents" not in text


@pytest.mark.dev
def test_a_phone_shows_the_verdict_and_charts_whole(driver, folder):
    """The table that is signed needs no scrolling, no button lies on a legend, maps have room."""
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    open_page(driver, folder / "good.html")
    table, bars, map_wide = driver.execute_script(
        "const map = document.querySelector('#chart-correlations .nsewdrag');"
        "return [document.querySelector('#verdict table').getBoundingClientRect().right,"
        " document.querySelectorAll('.modebar-btn').length, map.getBoundingClientRect().width]"
    )
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert table <= 390
    assert bars == 0
    assert map_wide > 195  # half of the screen; names and scale beside it had left it 40


@pytest.mark.dev
def test_hostile_names_are_shown_and_do_nothing(driver, folder):
    open_page(driver, folder / "bad.html")
    with pytest.raises(Exception, match="alert"):
        assert driver.switch_to.alert
    assert [e for e in driver.get_log("browser") if e["level"] == "SEVERE"] == []
    assert not [url for url in sent(driver)[1:] if not url.startswith(("data:", "blob:"))]
    text = replace_invisible_and_bidi_characters(NASTY)
    assert text in driver.execute_script("return document.querySelector('h1').textContent")
    assert driver.execute_script("return document.images.length") == 0
    labels = driver.execute_script(
        "return [...document.querySelectorAll('#chart-boxes .xtick text')].map(t => t.textContent)"
    )
    assert any("<script>alert(1)</script>" in shown for shown in labels)
    assert driver.execute_script("return document.querySelectorAll('svg a').length") == 0


@pytest.mark.dev
def test_without_depth_the_still_view_stands(driver, folder):
    blind = "HTMLCanvasElement.prototype.getContext = ((old) => function (kind, ...rest) {" \
        "return /webgl/.test(kind) ? null : old.call(this, kind, ...rest); })(" \
        "HTMLCanvasElement.prototype.getContext);"  # fmt: skip
    added = driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": blind})
    try:
        open_page(driver, folder / "good.html")
        assert driver.find_element("css selector", "svg.still").is_displayed()
        assert not driver.find_element("id", "times").is_displayed()
        assert driver.find_elements("css selector", "#chart-boxes .main-svg")
    finally:
        driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)


@pytest.mark.dev
def test_without_scripts_the_tables_and_the_still_view_stand(driver, folder):
    driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        driver.get((folder / "good.html").as_uri())
        assert driver.find_element("css selector", "#verdict table").is_displayed()
        assert driver.find_element("css selector", "svg.still").is_displayed()
    finally:
        driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})


@pytest.mark.usefixtures("browser")
def test_pdf_holds_the_whole_report(results, tmp_path):
    out, printed = tmp_path / "a.html", tmp_path / "a.pdf"
    files = (results / "fit.json", results / "gap.json")
    for given, more, pages in (
        (files, (), {4}),
        (files[:1], (), {4}),
        (files[1:], (), {4}),
        (files, ("--appendix",), set(range(9, 30))),
    ):
        assert run("report", *given, *more, "-o", out, "--pdf", printed) == 0
        raw = printed.read_bytes()
        assert raw.startswith(b"%PDF")
        assert raw.rstrip().endswith(b"%%EOF")
        assert len(re.findall(rb"/Type /Page\b", raw)) in pages
        assert len(raw) > 100_000  # the charts' lines and the letters


@pytest.mark.dev
def test_a_diagnosis_of_several_instruments_is_shown(driver, tmp_path):
    job = RelativeGapJob("irb2600", ("wires_3", "tracker"), "compliance", 1, 80)
    arm, rng = draw_arm(job), np.random.default_rng(4)
    found = diagnose_relative(
        arm.robot, [simulate_instrument(arm, k, 80, rng) for k in job.instruments]
    )
    path = tmp_path / "relative.html"
    path.write_text(render_html(build_report(read_report_sources([found]), WORDING)))
    open_page(driver, path)
    assert [e for e in driver.get_log("browser") if e["level"] == "SEVERE"] == []
    text = driver.execute_script("return document.body.innerText")
    for word in (found.reasons[0], "error budget", "joint compliance", "confirmed"):
        assert word.lower() in text.lower(), word
    assert driver.find_element("css selector", "#budget table").is_displayed()

"""The page in a real browser: from dropped files to a passed report and a robot to take away."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import browsing
from conftest import run, shared
from numpy.testing import assert_allclose
from served import PATIENCE, Served

import minimax_cal as mc
from minimax_cal.webapp.sessions import UPLOAD_FOLDER

pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
pytestmark = pytest.mark.dev
PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
POSES, TARGETS = 30, 2
PASSED = "Passed inside the measured region"
DIGITS = 1e-8  # of measurements that import writes: half a nanometre and a nanoradian [m]
HUGE = """
const file = new File(["x"], "huge.csv");
Object.defineProperty(file, "size", { value: 2 * 2 ** 30 });
const input = document.getElementById("measured");
Object.defineProperty(input, "files", { value: [file], configurable: true });
input.dispatchEvent(new Event("change", { bubbles: true }));
delete input.files;
"""


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic cell."""
    path = tmp_path_factory.mktemp("cell") / "tracker.csv"
    mc.write_measurements(path, mc.simulate("irb120", POSES, TARGETS, seed=4).data)
    return path


# ---- what people do ------------------------------------------------------------------------------


def until(what: Callable[[], Any], said: str) -> Any:
    """What becomes true in time."""
    end = time.monotonic() + PATIENCE
    while not (found := what()):
        assert time.monotonic() < end, said
        time.sleep(0.1)
    return found


def one(driver: Any, selector: str) -> Any:
    return driver.find_element("css selector", selector)


def begin(driver: Any, server: Served, title: str) -> None:
    """Open the address that was printed, and begin a session."""
    driver.get(server.url)
    one(driver, "#title").send_keys(title)
    one(driver, "button[type=submit]").click()
    stamp = "return document.body?.dataset.stamp"
    until(lambda: driver.execute_script(stamp), "the page came to no state")


def state(driver: Any, step: str) -> str:
    script = "return document.querySelector(arguments[0])?.dataset.state ?? ''"
    return str(driver.execute_script(script, f"[data-said={step}], [data-badge={step}]"))


def wait_for(driver: Any, step: str) -> None:
    """A step that has just begun is done."""
    until(lambda: state(driver, step) in ("done", "failed"), f"{step} did not end")
    said = one(driver, f"[data-said={step}]").get_attribute("textContent")
    assert state(driver, step) == "done", said


def click(driver: Any, selector: str) -> None:
    """As a person does, once it can be pressed."""
    button = one(driver, selector)
    until(button.is_enabled, f"{selector} stays disabled")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
    button.click()


def do(driver: Any, step: str, where: str = "") -> None:
    click(driver, f"{where} [data-run={step}]")
    until(lambda: state(driver, step) != "ready", f"{step} did not begin")
    wait_for(driver, step)


def drop(driver: Any, kind: str, *paths: Path) -> None:
    one(driver, f"[data-drop={kind}] input").send_keys("\n".join(map(str, paths)))


def fill(driver: Any, selector: str, value: str) -> None:
    field = one(driver, selector)
    field.clear()
    field.send_keys(value, "\t")


def severe(driver: Any) -> list[Any]:
    return [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]


def asked(driver: Any) -> set[str]:
    """Where the page's requests went."""
    events = [json.loads(e["message"])["message"] for e in driver.get_log("performance")]
    urls = [e["params"]["request"]["url"] for e in events
            if e["method"] == "Network.requestWillBeSent"]  # fmt: skip
    return {"/".join(url.split("/")[:3]) for url in urls if not url.startswith(("data:", "blob:"))}


def session_of(driver: Any, server: Served) -> Path:
    return server.folder / str(one(driver, "body").get_attribute("data-session"))


def same_as_the_command_line(folder: Path, robot: str, elsewhere: Path) -> None:
    """The fit of the page is that of `calibrate` on its measurements, to the last digit."""
    out = elsewhere / "fit.json"
    assert run("calibrate", robot, folder / "poses.csv", "-o", out) == 0
    ours, theirs = (json.loads(path.read_text()) for path in (folder / "fit.json", out))
    for key in ("parameters", "accuracy", "base", "targets_mm"):
        assert ours[key] == theirs[key], key


# ---- the whole way -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(driver: Any, server: Served, poses: Path) -> Any:
    """The browser with a session that was dropped and fitted; tests leave it so."""
    severe(driver), asked(driver)  # of pages before
    begin(driver, server, "Cell 7")
    drop(driver, "measured", poses)
    wait_for(driver, "read")
    assert f"{POSES} poses, 6 joints" in one(driver, "[data-panel=understood]").text
    one(driver, "#robot-choice [value=irb120]").click()
    do(driver, "fit", "#fit")
    return driver


def test_from_dropped_files_to_a_passed_report(fitted, server, downloads, tmp_path):
    driver = fitted
    folder = session_of(driver, server)
    same_as_the_command_line(folder, "irb120", tmp_path)
    line = f"minimax-cal calibrate irb120 {'poses.csv'} --objective minimax -o fit.json"
    assert line in one(driver, "[data-said=fit]").text

    until(lambda: one(driver, "#chart-workspace").get_attribute("data-drawn"), "no view")
    fill(driver, "#cell [name=most]", "0.001")
    place = "return document.getElementById('chart-workspace')"
    drawn = f"{place}.data.map(t => [t.x[0], t.y[0], t.z[0]])"
    arrow, reflector, *_ = driver.execute_script(drawn)
    assert arrow == reflector
    names = f"{place}.data.map(t => t.name)"
    until(lambda: "beyond 0.001 mm" in str(driver.execute_script(names)), "no red")
    count = driver.execute_script("return document.querySelectorAll('tr.beyond').length")
    assert count > POSES * TARGETS / 2

    fill(driver, "#judge [name=most]", "")
    fill(driver, "#judge [name=rms]", "5")
    do(driver, "judge")
    assert one(driver, "[data-panel=verdict] .banner").text == PASSED

    do(driver, "urdf")
    click(driver, "[data-panel=downloads] a[href$='robot.urdf']")
    kept = downloads / "robot.urdf"
    until(kept.is_file, "the URDF did not arrive")
    assert kept.read_bytes() == (folder / "robot.urdf").read_bytes()
    arm = tmp_path / "arm.urdf"
    assert run("export", folder / "fit.json", "--to", "urdf", "-o", arm) == 0
    assert kept.read_bytes() == arm.read_bytes()
    assert severe(driver) == []
    assert asked(driver) == {f"http://127.0.0.1:{server.port}"}


def test_a_dh_table_can_be_typed(driver, server, poses):
    """The table of the nominal arm, typed in, is the arm of the fit."""
    begin(driver, server, "Typed")
    drop(driver, "measured", poses)
    wait_for(driver, "read")
    click(driver, "#dh summary")
    arm = mc.load_robot("irb120")
    for i, (a, d, theta, alpha, _) in enumerate(arm.mdh):
        values = (1e3 * a, *np.degrees([alpha]), 1e3 * d, *np.degrees([theta]))
        row = f"#dh-table tbody tr:nth-child({i + 1}) input"
        fields = driver.find_elements("css selector", row)
        for field, value in zip(fields, values, strict=False):
            field.clear()
            field.send_keys(f"{value:.9g}")
        fields[5].clear()
        fields[5].send_keys(f"{arm.sign[i]:.0f}")
    click(driver, "#dh-use")
    folder = session_of(driver, server)
    until((folder / UPLOAD_FOLDER / "arm.csv").is_file, "the table did not arrive")
    until(lambda: state(driver, "robot") == "done", "the table is not chosen")
    do(driver, "fit", "#fit")
    assert "convention: standard" in (folder / UPLOAD_FOLDER / "arm.csv").read_text()
    typed = mc.load_fit(folder / "fit.json")
    assert typed.within.after.rms_mm == pytest.approx(
        mc.calibrate("irb120", folder / "poses.csv").within.after.rms_mm, rel=1e-3
    )
    assert severe(driver) == []


def unticked(driver: Any) -> tuple[str, str]:
    """Untick the worst point; its line and target."""
    tick = one(driver, "[data-panel=points] input[data-point]").get_attribute("id")
    click(driver, f"#{tick}")
    until(lambda: state(driver, "fit") == "old", "the choice did not arrive")
    line, target = tick.removeprefix("use-").split("-")
    return line, target


def test_a_point_can_be_unticked_and_taken_back(fitted):
    driver = fitted
    line, target = unticked(driver)
    assert f"--leave-out={line}:{target} -o used.csv" in one(driver, "[data-said=fit]").text
    assert one(driver, "#points tr.out").get_attribute("id") == f"point-{line}-{target}"
    why = one(driver, f"#why-{line}-{target}")
    why.send_keys("nest knocked\t")
    reason = f"'--leave-out={line}:{target}=nest knocked'"
    until(lambda: reason in one(driver, "[data-said=fit]").text, "the reason did not arrive")
    click(driver, "#all-back")
    until(lambda: state(driver, "fit") == "done", "the choice did not arrive")
    assert severe(driver) == []


def test_what_is_too_large_is_refused_by_the_page(fitted, server):
    driver = fitted
    driver.execute_script(HUGE)
    problem = one(driver, "#problem")
    until(problem.is_displayed, "nothing was said")
    assert problem.text == "huge.csv: is larger than 256 MiB; that is no file of measurements"
    assert not (session_of(driver, server) / "given" / "huge.csv").exists()


def test_a_phone_shows_all_of_it(fitted):
    driver = fitted
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", PHONE)
    time.sleep(0.5)
    wide = driver.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert wide[0] <= wide[1]


def test_a_wrong_token_is_told(driver, server):
    driver.delete_all_cookies()
    driver.get(f"http://127.0.0.1:{server.port}/?token=wrong")
    assert one(driver, "body").text.startswith("wrong token: open the address that minimax-cal")
    driver.get_log("browser")


# ---- in full -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_whole_work_in_two_browsers(server, tmp_path, tmp_path_factory):
    """One drops and fits, the other sees it, and both go on at once in two sessions."""
    data, targets = tmp_path / "tracker.csv", tmp_path / "targets.csv"
    truth = mc.Truth(compliance=1.5e-6)
    mc.write_measurements(data, mc.simulate("irb120", 60, 3, seed=3, truth=truth).data)
    targets.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,-10,30,40,50\n")
    with browsing(tmp_path) as left, browsing(tmp_path_factory.mktemp("kept")) as right:
        begin(left, server, "shared")
        right.get(server.url)
        right.get(left.current_url)
        drop(left, "measured", data)
        one(left, "#robot-choice [value=irb120]").click()
        wait_for(right, "read")
        begin(right, server, "another")
        drop(right, "measured", data)
        wait_for(right, "read")
        one(right, "#robot-choice [value=irb120]").click()
        for browser in (left, right):
            click(browser, "#fit [data-run=fit]")
        for browser in (left, right):
            until(lambda b=browser: state(b, "fit") != "ready", "the fit did not begin")
            wait_for(browser, "fit")
        folders = [session_of(browser, server) for browser in (left, right)]
        one_fit, other = (json.loads((f / "fit.json").read_text()) for f in folders)
        assert one_fit["parameters"] == other["parameters"]

        line, target = unticked(left)
        do(left, "fit", "#points")
        poses = json.loads((folders[0] / "fit.json").read_text())["poses"]
        row = poses["line"].index(int(line))
        assert poses["measured_mm"][row][poses["targets"].index(target)] == [None, None, None]

        click(left, "[data-run=diagnose]")
        rung = "return document.querySelector('[data-panel=ladder] tbody th')?.textContent"
        grown = until(lambda: left.execute_script(rung), "no rung was shown while it worked")
        assert grown == "nominal arm"
        assert state(left, "diagnose") == "working"
        wait_for(left, "diagnose")
        until(lambda: one(left, "#chart-ladder").get_attribute("data-drawn"), "no ladder")
        click(left, "[name=effects]")
        until(lambda: state(left, "fit") == "old", "the choice did not arrive")
        do(left, "fit", "#fit")
        assert "--effects diagnosis.json" in one(left, "[data-said=fit]").text
        fill(left, "#judge [name=rms]", "0.1")
        do(left, "judge")
        assert one(left, "[data-panel=verdict] .banner").text == f"{PASSED} for corrected targets"
        do(left, "plan")
        do(left, "mjcf")
        drop(left, "targets", targets)
        until(lambda: "targets.csv" in one(left, "#targets-told").text, "no targets")
        do(left, "correct")
        for name in ("next.csv", "robot.xml", "corrected.csv", "report.html", "commands.sh"):
            assert (folders[0] / name).stat().st_size > 100, name
        assert severe(left) == severe(right) == []

        left.get(f"{left.current_url.partition('#')[0]}/file/report.html?look")  # in its sandbox
        drawn = "return document.body.dataset.drawn"
        assert until(lambda: left.execute_script(drawn), "the report was not drawn") == "yes"
        assert left.execute_script("return self.origin") == "null"
        assert severe(left) == []


@pytest.mark.slow
def test_a_real_arm(driver, server, tmp_path):
    robot, data = map(Path, shared("irb120"))
    begin(driver, server, "irb120")
    drop(driver, "measured", data)
    wait_for(driver, "read")
    drop(driver, "robot", robot)
    until(lambda: state(driver, "robot") == "done", "no robot")
    do(driver, "fit", "#fit")
    folder = session_of(driver, server)
    same_as_the_command_line(folder, str(robot), tmp_path)
    assert run("calibrate", robot, data, "-o", tmp_path / "direct.json") == 0
    ours, direct = (mc.load_fit(p) for p in (folder / "fit.json", tmp_path / "direct.json"))
    assert_allclose(ours.error, direct.error, rtol=0, atol=DIGITS)  # of the file as it came
    fill(driver, "#judge [name=rms]", "1")
    do(driver, "judge")
    assert one(driver, "[data-panel=verdict] .banner").text == PASSED
    do(driver, "urdf")
    assert (folder / "robot.urdf").stat().st_size > 1000
    assert severe(driver) == []

"""Make the picture of the page to work in again: python docs/serve_page.py [PNG].

A simulated arm that gives way under gravity is diagnosed, calibrated with what that establishes,
and judged on the page.  Needs Chromium with its chromedriver, and selenium.
"""

import base64
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import HTTPCookieProcessor, Request, build_opener

import minimax_cal as mc

CHOICES = {
    "measured": ["tracker.csv"],
    "robot": "irb2600",
    "effects": True,
    "rms": 0.1,
    "most": 0.1,
}
STEPS = ("read", "diagnose", "fit", "judge")
SIZE = (1280, 1000)
FLAGS = ("--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader",
         "--hide-scrollbars", f"--window-size={SIZE[0]},{SIZE[1]}")  # fmt: skip
DRAWN = """
return ["workspace", "ladder"].every((n) => document.getElementById(`chart-${n}`).dataset.drawn);
"""
BOX = """
const top = document.getElementById("fit").getBoundingClientRect().top + scrollY - 12;
const end = document.getElementById("diagnose").getBoundingClientRect().bottom + scrollY + 12;
document.querySelector("nav").style.position = "static";
return [top, end - top];
"""


def make(picture: Path) -> None:
    """The page with a calibration and its diagnosis."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "minimax_cal.cli", "serve", "--port", "0", "--no-browser"]
        server = subprocess.Popen([*command, "--folder", folder], stdout=subprocess.PIPE, text=True)
        try:
            url = server.stdout.readline().strip() if server.stdout else ""
            home, _, token = url.partition("/?token=")
            name = worked(home, url, Path(folder))
            picture.write_bytes(photographed(f"{home}/s/{name}?token={token}"))
        finally:
            server.terminate()
            server.wait()


def worked(home: str, url: str, folder: Path) -> str:
    """All steps of a session; its name."""
    opener = build_opener(HTTPCookieProcessor())
    opener.open(url).read()

    def ask(method: str, path: str, content: bytes = b"") -> Any:
        request = Request(f"{home}{path}", content or None, method=method)
        return json.loads(opener.open(request).read())

    name = ask("POST", "/sessions", b'{"title": "Cell 7"}')["name"]
    data = folder / "tracker.csv"
    made = mc.simulate("irb2600", 100, 3, seed=3, truth=mc.Truth(compliance=1.5e-6))
    mc.write_measurements(data, made.data)
    ask("PUT", f"/s/{name}/given?name=tracker.csv", data.read_bytes())
    ask("PATCH", f"/s/{name}/choices", json.dumps(CHOICES).encode())
    for step in STEPS:
        ask("POST", f"/s/{name}/run/{step}", b" ")
        until(lambda: not ask("GET", f"/s/{name}/state")["job"])
    return str(name)


def photographed(url: str) -> bytes:
    """The page from the calibration to the diagnosis, as PNG."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for flag in FLAGS:
        options.add_argument(flag)
    service = webdriver.ChromeService(shutil.which("chromedriver"))
    driver = webdriver.Chrome(options=options, service=service)
    try:
        driver.get(url)
        until(lambda: driver.execute_script(DRAWN))
        time.sleep(1.0)  # the last frame
        top, height = driver.execute_script(BOX)
        clip = {"x": 0, "y": top, "width": SIZE[0], "height": height, "scale": 1}
        shot = driver.execute_cdp_cmd(
            "Page.captureScreenshot", {"captureBeyondViewport": True, "clip": clip}
        )
        return base64.b64decode(shot["data"])
    finally:
        driver.quit()


def until(what: Callable[[], Any]) -> None:
    """Wait for it."""
    while not what():
        time.sleep(0.2)


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images/serve.png")

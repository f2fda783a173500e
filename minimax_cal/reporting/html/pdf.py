"""A report on paper, or its first page as a picture, by an installed Chromium, Chrome or Edge."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import write_whole

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "msedge",
    "microsoft-edge",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
)
FLAGS = (
    "--headless",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-extensions",
    "--no-first-run",
    "--no-pdf-header-footer",
)
SHEET = "794,1123"  # A4 in CSS pixels
PATIENCE = 180.0  # seconds that a browser may take
HINT = "open the HTML file in a browser and print it from there"


def find_browser() -> str:
    """A browser that prints without a window.  Raises OptionError where there is none."""
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    raise OptionError(f"paper needs Chromium, Chrome or Edge, and none was found; {HINT}")


def print_pdf(page: str, path: Path, browser: str) -> None:
    """Write a page as PDF; nothing is written where the browser fails.  Raises CalibrationError."""
    made(page, path, browser, "report.pdf", "--print-to-pdf={}")


def picture(page: str, path: Path, browser: str) -> None:
    """Write the first page of a page for paper as PNG, A4.  Raises CalibrationError.

    What holds for print holds for the screen then.
    """
    sheet = page.replace("@media print {", "@media all {")
    sheet = sheet.replace("<html ", "<html data-sheet ", 1)
    flags = ("--hide-scrollbars", f"--window-size={SHEET}", "--force-device-scale-factor=2")
    made(sheet, path, browser, "page.png", "--screenshot={}", *flags)


def made(page: str, path: Path, browser: str, name: str, flag: str, *more: str) -> None:
    """What a browser makes of a page, written whole.  Raises CalibrationError."""
    with tempfile.TemporaryDirectory(prefix="minimax-cal-", ignore_cleanup_errors=True) as where:
        folder = Path(where)
        source, target = folder / "report.html", folder / name
        source.write_text(page, encoding="utf-8")
        command = [
            browser,
            *FLAGS,
            *more,
            *(["--no-sandbox"] if is_root() else []),
            f"--user-data-dir={folder / 'profile'}",
            flag.format(target),
            source.as_uri(),
        ]
        try:
            subprocess.run(command, capture_output=True, timeout=PATIENCE, check=True)
            content = target.read_bytes()
        except (OSError, subprocess.SubprocessError) as error:
            raise CalibrationError(
                f"{path}: {browser} could not print it ({type(error).__name__}); {HINT}"
            ) from error
    write_whole(path, content)


def is_root() -> bool:
    """Whether this is the administrator of a Unix machine, for whom Chromium has no sandbox."""
    return hasattr(os, "geteuid") and os.geteuid() == 0

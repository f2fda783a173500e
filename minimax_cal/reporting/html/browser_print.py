"""A report on paper, or its first page as a picture, by an installed Chromium, Chrome or Edge."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import write_file_atomically

BROWSER_COMMANDS = (
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
BROWSER_FLAGS = (
    "--headless",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-extensions",
    "--no-first-run",
    "--no-pdf-header-footer",
)
A4_CSS_PIXELS = "794,1123"  # A4 in CSS pixels
MAX_BROWSER_SECONDS = 180.0  # seconds that a browser may take
PRINT_BY_HAND_HINT = "open the HTML file in a browser and print it from there"


def find_browser() -> str:
    """A browser that prints without a window.  Raises OptionError where there is none."""
    for name in BROWSER_COMMANDS:
        if found := shutil.which(name):
            return found
    raise OptionError(
        f"paper needs Chromium, Chrome or Edge, and none was found; {PRINT_BY_HAND_HINT}"
    )


def write_pdf(page_html: str, path: Path, browser_command: str) -> None:
    """Write a page as PDF; nothing is written where the browser fails.  Raises CalibrationError."""
    write_browser_output(page_html, path, browser_command, "report.pdf", "--print-to-pdf={}")


def write_first_page_png(page_html: str, path: Path, browser_command: str) -> None:
    """Write the first page of a page for paper as PNG, A4.  Raises CalibrationError.

    What holds for print holds for the screen then.
    """
    sheet = page_html.replace("@media print {", "@media all {")
    sheet = sheet.replace("<html ", "<html data-sheet ", 1)
    flags = ("--hide-scrollbars", f"--window-size={A4_CSS_PIXELS}", "--force-device-scale-factor=2")
    write_browser_output(sheet, path, browser_command, "page.png", "--screenshot={}", *flags)


def write_browser_output(
    page_html: str,
    path: Path,
    browser_command: str,
    output_name: str,
    output_flag: str,
    *more_flags: str,
) -> None:
    """What a browser makes of a page, written whole.  Raises CalibrationError."""
    with tempfile.TemporaryDirectory(prefix="minimax-cal-", ignore_cleanup_errors=True) as where:
        folder = Path(where)
        source, target = folder / "report.html", folder / output_name
        source.write_text(page_html, encoding="utf-8")
        command = [
            browser_command,
            *BROWSER_FLAGS,
            *more_flags,
            *(["--no-sandbox"] if is_unix_root() else []),
            f"--user-data-dir={folder / 'profile'}",
            output_flag.format(target),
            source.as_uri(),
        ]
        try:
            subprocess.run(command, capture_output=True, timeout=MAX_BROWSER_SECONDS, check=True)
            content = target.read_bytes()
        except (OSError, subprocess.SubprocessError) as error:
            raise CalibrationError(
                f"{path}: {browser_command} could not print it "
                f"({type(error).__name__}); {PRINT_BY_HAND_HINT}"
            ) from error
    write_file_atomically(path, content)


def is_unix_root() -> bool:
    """Whether this is the administrator of a Unix machine, for whom Chromium has no sandbox."""
    return hasattr(os, "geteuid") and os.geteuid() == 0

"""Make the pictures of README and documentation again: python docs/pictures.py [PICTURE ...].

Without a name those of the program itself, in some minutes (the report's needs Chromium, Chrome or
Edge, the page's Chromium with its chromedriver); a picture of a study by its name, as coverage.png,
by running that study as its page has it.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import minimax_cal as mc
from minimax_cal.reporting.plots.diagnosis_figure import save_diagnosis

DOCS = Path(__file__).resolve().parent
ROOT, IMAGES = DOCS.parent, DOCS / "images"
sys.path += [str(DOCS), str(ROOT), str(ROOT / "examples")]

from experiments.pages import PAGE_RUNS  # noqa: E402

STUDIES = {  # picture: the study, and what it calls the picture in its folder
    "simulator_gap.png": ("simulator_gap", "simulator_gap_ladder"),
}
OF_PAGES = {picture for run in PAGE_RUNS.values() for picture in run.pictures}


def example() -> None:
    """The README's first picture, with its measurements."""
    import make

    make.make(ROOT / "examples")


def diagnosis() -> None:
    """The README's picture of a diagnosis, as its commands make it."""
    found = mc.diagnose("irb2600", ROOT / "examples" / "irb2600.csv")
    save_diagnosis(found, IMAGES / "diagnosis.png")


def report() -> None:
    """The first page of a report."""
    import first_page

    first_page.make(IMAGES / "report.png")


def page() -> None:
    """The page to work in."""
    import serve_page

    serve_page.make(IMAGES / "serve.png")


OWN = {
    "irb2600.svg": example,
    "diagnosis.png": diagnosis,
    "report.png": report,
    "serve.png": page,
}


def from_studies(names: list[str]) -> None:
    """Pictures of studies, each study run once."""
    for study in dict.fromkeys(STUDIES[name][0] for name in names):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "experiments", study, "--out", folder]
            subprocess.run(command, check=True, cwd=ROOT)
            for name in names:
                if STUDIES[name][0] == study:
                    shutil.copy(Path(folder) / f"{STUDIES[name][1]}.png", IMAGES / name)


def main(names: list[str]) -> None:
    """Make the pictures of these names, or those of the program itself."""
    for name in OF_PAGES.intersection(names):
        study = next(study for study, run in PAGE_RUNS.items() if name in run.pictures)
        sys.exit(f"{name}: python -m experiments pages --run {study}")
    unknown = [name for name in names if name not in OWN and name not in STUDIES]
    if unknown:
        sys.exit(f"no picture {unknown[0]!r}; choose {', '.join((*OWN, *STUDIES))}")
    for name in names or OWN:
        if name in OWN:
            OWN[name]()
    from_studies([name for name in names if name in STUDIES])


if __name__ == "__main__":
    main(sys.argv[1:])

"""From result files to a report: its title block, verdict, sections and provenance."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import visible
from minimax_cal.reporting.html import fit_sections, gap_sections, simulator_section
from minimax_cal.reporting.html.content import Block, Blocks, Note, Report, Section, missing, text
from minimax_cal.reporting.html.fit_tables import glance_table, settings_table
from minimax_cal.reporting.html.sources import Sources
from minimax_cal.reporting.html.verdict import fit_verdict, gap_verdict

NO_FIT = (
    "Not in this report: it was made without a calibration; give the file of `minimax-cal "
    "calibrate -o` as well."
)
NO_GAP = (
    "Not in this report: it was made without a diagnosis; give the file of `minimax-cal diagnose "
    "-o` as well."
)
HEX = re.compile(r"[0-9a-f]{64}")


def of_fit(blocks: Callable[[Fit], Blocks]) -> Callable[[Sources], Blocks]:
    """What needs a calibration, or that there is none."""
    return lambda sources: blocks(sources.fit) if sources.fit else [missing(NO_FIT)]


def of_gap(blocks: Callable[[Diagnosis], Blocks]) -> Callable[[Sources], Blocks]:
    """What needs a diagnosis, or that there is none."""
    return lambda sources: blocks(sources.gap) if sources.gap else [missing(NO_GAP)]


SECTIONS = (  # name, title, what it holds
    ("accuracy", "Accuracy", fit_sections.accuracy),
    ("workspace", "The errors in the workspace", fit_sections.errors_in_space),
    ("joints", "What the errors go with", fit_sections.joints),
    ("gap", "The gap, step by step", of_gap(gap_sections.gap_steps)),
    ("causes", "Causes, and their rivals", of_gap(gap_sections.causes)),
    ("where", "Where geometry leaves errors", of_gap(gap_sections.places)),
    ("untestable", "What could not be tested", of_gap(gap_sections.untestable)),
    ("simulator", "The arm in the simulator", simulator_section.blocks),
    ("suspects", "Suspect points", fit_sections.suspect_points),
    ("parameters", "Parameters", of_fit(fit_sections.parameters)),
    ("correlations", "How the parameters hang together", of_fit(fit_sections.correlated)),
    ("iso9283", "Values by the formulas of ISO 9283", of_fit(fit_sections.iso_values)),
    ("solution", "How the fit was found", of_fit(fit_sections.solution)),
)


@dataclass(frozen=True)
class Wording:
    """What the user says of a report, empty where nothing.  date: of the report, ISO 8601."""

    date: str
    title: str = ""
    customer: str = ""
    author: str = ""


def compose(sources: Sources, wording: Wording) -> Report:
    """The whole report.  Raises CalibrationError for a part of a file that cannot be read."""
    told = sources.provenance
    both = " and ".join(kind for kind, _ in named(sources)).capitalize()
    facts = [("Robot", sources.robot)]
    facts += [("Customer", visible(wording.customer))] if wording.customer else []
    facts += [("Author", visible(wording.author))] if wording.author else []
    facts += [("Date of this report", wording.date), ("Poses", counted(sources))]
    facts += [("Measurements", told.data or "not named")]
    facts += [("SHA-256 of the measurements", told.data_sha256 or "not recorded")]
    sections = (
        Section(name, title, tuple(made(sources)))
        for name, title, made in SECTIONS
        if name != "simulator" or sources.simulator
    )
    return Report(
        title=visible(wording.title) or f"{both} of {sources.robot}",
        robot=sources.robot,
        facts=tuple(facts),
        signatures=signers(visible(wording.author), visible(wording.customer)),
        sections=(verdict_section(sources), *sections, provenance_section(sources)),
        digest=told.data_sha256 if HEX.fullmatch(told.data_sha256) else "",
    )  # fmt: skip


def signers(author: str, customer: str) -> tuple[tuple[str, str], ...]:
    """Who signs: role, and name where it is known."""
    accepted = f"Accepted for {customer}" if customer else "Accepted"
    return (("Measured and evaluated", author), ("Checked", ""), (accepted, ""))


def counted(sources: Sources) -> str:
    """How many poses and targets there are."""
    if sources.fit:
        held, train = sources.fit.accuracy["holdout"].poses, sources.fit.accuracy["train"].poses
    elif sources.gap:
        first = sources.gap.ladder[0]
        held, train = first.holdout.poses, first.train.poses
    targets = len(sources.cell.target_names) if sources.cell else 0
    seen = f", {targets} target{'s' if targets > 1 else ''}" if targets else ""
    return f"{train} training, {held} held out{seen}"


def named(sources: Sources) -> list[tuple[str, Fit | Diagnosis]]:
    """The results with what they are."""
    both = (("calibration", sources.fit), ("diagnosis", sources.gap))
    return [(kind, result) for kind, result in both if result]


def verdict_section(sources: Sources) -> Section:
    """The result in words and in four numbers."""
    blocks: list[Block] = [Note(notice, "warning") for notice in sources.notices]
    blocks += fit_verdict(sources.fit) if sources.fit else ()
    table = glance_table(sources)
    blocks += [table] if table.rows else []
    blocks += gap_verdict(sources.gap) if sources.gap else ()
    return Section("verdict", "Verdict", tuple(blocks))


def provenance_section(sources: Sources) -> Section:
    """Files, settings, versions and notices: what it takes to have the numbers again."""
    files: list[tuple[str, str, str]] = []
    settings: list[Table] = []
    notices: list[Block] = []
    for kind, result in named(sources):
        files += [(f.kind, visible(f.path), f.digest) for f in sources.files if f.kind == kind]
        told = result.provenance
        if (row := ("measurements", told.data, told.data_sha256 or "not recorded")) not in files:
            files.append(row)
        settings.append(settings_table(f"Settings of the {kind}", told.settings))
        settings.append(Table(f"Versions used by the {kind}", ("package", "version"),
                              tuple(told.versions.items())))  # fmt: skip
        notices += [Note(f"{kind}: {notice}", "notice") for notice in result.notices]
    made = (("minimax-cal", version("minimax-cal")), ("plotly", version("plotly")))
    settings.append(Table("This report was made by", ("package", "version"), made))
    return Section(
        "provenance",
        "Provenance",
        (
            Table("Files", ("what", "file", "SHA-256"), tuple(files)),
            *(table for table in settings if table.rows),
            *(notices or [text("The programs gave no notices.")]),
        ),
    )

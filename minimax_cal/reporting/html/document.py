"""From result files to a report: its title block, verdict, sections and provenance."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.words import visible
from minimax_cal.judging.tolerance import Limit
from minimax_cal.reporting.html import appendix, pages
from minimax_cal.reporting.html.content import Block, Blocks, Note, Report, Section, bound, text
from minimax_cal.reporting.html.facts import told_facts
from minimax_cal.reporting.html.first_page import Signed, page_blocks, signed
from minimax_cal.reporting.html.sources import Sources, named

FILES, PACKAGES = "what | file | SHA-256", "package | version"  # columns of tables
HEX = re.compile(r"[0-9a-f]{64}")
FOLDERS = re.compile(r"(?:[A-Za-z]:)?[^,]*[/\\](?=[^/\\,]+\.[A-Za-z]\w*(?:,|$))")  # before a file


def of_fit(blocks: Callable[[Fit], Blocks]) -> Callable[[Sources], Blocks]:
    """What needs a calibration; nothing without one."""
    return lambda sources: blocks(sources.fit) if sources.fit else ()


PAGES = (  # name, title, what it holds: after the page to sign
    ("budget", "Error budget", pages.budget),
    ("where", "Where the errors are", pages.where),
    ("parameters", "Parameters", pages.parameters),
)
APPENDIX = (
    ("accuracy", "How large the errors are", appendix.accuracy),
    ("joints", "What the errors go with", appendix.joints),
    ("correlations", "How the parameters hang together", of_fit(appendix.correlated)),
    ("iso9283", "Values by the formulas of ISO 9283", of_fit(appendix.iso_values)),
    ("solution", "How the fit was found", of_fit(appendix.solution)),
    ("simulator", "The arm in the simulator", appendix.simulator),
)


@dataclass(frozen=True)
class Wording:
    """What the user says of a report, empty where nothing.

    date: of the report, ISO 8601.  facts: by the keys of `facts.FACTS`.  limits: what is required,
    which: of which claim, inside or outside.  rung: of a diagnosis.
    deliver: by which deliverables.  appendix: whether it holds more than the four pages.
    """

    date: str
    title: str = ""
    customer: str = ""
    author: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)
    limits: tuple[Limit, ...] = ()
    which: str = "inside"
    rung: int | None = None
    deliver: tuple[str, ...] = ()
    appendix: bool = False

    def judge(self, sources: Sources) -> Signed:
        """What the page judges.  Raises OptionError."""
        return signed(sources, self.limits, self.which, self.rung, self.deliver)


def compose(sources: Sources, wording: Wording, found: Signed | None = None) -> Report:
    """The whole report.  Raises CalibrationError for a part of a file that cannot be read.

    found: the judgement, where it was made already.
    """
    told = sources.provenance
    kind = named(sources)[0][0].capitalize()
    data = sources.results[0].data if not sources.relative else None
    facts = [("Robot", sources.robot), *told_facts(wording.facts, data)]
    facts += [("Customer", visible(wording.customer))] if wording.customer else []
    facts += [("Date of this report", wording.date), ("Poses", counted(sources))]
    facts += [("Measurements", file_name(told.data) or "not named")]
    facts += [("SHA-256 of the measurements", told.data_sha256 or "not recorded")]
    found = found or wording.judge(sources)
    sheets = [Section("verdict", "Requirement and result", page_blocks(sources, found))]
    sheets += [Section(name, title, tuple(made(sources))) for name, title, made in PAGES]
    more = [Section(name, title, tuple(made(sources))) for name, title, made in APPENDIX]
    more += appendix.other_tables(sources, [*sheets, *more])
    return Report(
        title=visible(wording.title) or f"{kind} of {sources.robot}",
        robot=sources.robot,
        facts=tuple(facts),
        signatures=signers(visible(wording.author), visible(wording.customer)),
        sections=bound(sheets, [*more, provenance_section(sources)], wording.appendix),
        digest=told.data_sha256 if HEX.fullmatch(told.data_sha256) else "",
    )


def file_name(named: str) -> str:
    """Files without the folders of the machine; what is no file stays as it is."""
    return FOLDERS.sub("", visible(named))


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
    elif sources.relative:
        held, train = (sources.relative.accuracy[key].poses for key in ("holdout", "train"))
    targets = len(sources.cell.target_names) if sources.cell else 0
    seen = f", {targets} target{'s' if targets > 1 else ''}" if targets else ""
    return f"{train} training, {held} held out{seen}"


def provenance_section(sources: Sources) -> Section:
    """Files, settings, versions and notices: what it takes to have the numbers again."""
    files: dict[tuple[str, str, str], None] = {}
    settings: list[Table] = []
    notices: list[Block] = []
    for kind, result in named(sources):
        told = result.provenance
        own = [(f.kind, file_name(f.path), f.digest) for f in sources.files if f.kind == kind]
        data = ("measurements", file_name(told.data), told.data_sha256 or "not recorded")
        files |= dict.fromkeys([*own, data])
        rows = [(name, words(value)) for name, value in told.settings.items()]
        settings.append(Table.made(f"Settings of the {kind}", rows, "setting | value"))
        versions = told.versions.items()
        settings.append(Table.made(f"Versions used by the {kind}", versions, PACKAGES))
        notices += [Note(f"{kind}: {notice}", "notice") for notice in result.notices]
    notices = notices or [text("The programs gave no notices.")]
    every = (Table.made("Files", files, FILES), *filled(*settings), made_by(), *notices)
    return Section("provenance", "Provenance", every)


def made_by() -> Table:
    """The programs that made a report."""
    rows = ((name, version(name)) for name in ("minimax-cal", "plotly"))
    return Table.made("This report was made by", rows, PACKAGES)


def words(value: Any) -> str:
    """A setting as text."""
    if value is None:
        return "default"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key} = {part}" for key, part in value.items()) or "none"
    return str(value)

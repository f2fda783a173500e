"""From result files to a report: its title block, verdict, sections and provenance."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, NamedTuple

from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.fitting.fit import Fit
from minimax_cal.reporting.html import report_appendix, report_pages
from minimax_cal.reporting.html.cell_facts import list_labelled_facts
from minimax_cal.reporting.html.first_page import (
    ReportJudgement,
    build_first_page_blocks,
    judge_sources,
)
from minimax_cal.reporting.html.report_content import (
    NoteBlock,
    ReportBlock,
    ReportBlocks,
    ReportDocument,
    ReportSection,
    build_text_note,
    join_pages_and_appendix,
)
from minimax_cal.reporting.html.report_sources import ReportSources, list_named_results
from minimax_cal.validation.tolerance import ToleranceLimit

FILE_TABLE_COLUMNS, PACKAGE_TABLE_COLUMNS = (
    "what | file | SHA-256",
    "package | version",
)  # columns of tables
SHA256_PATTERN = re.compile(r"[0-9a-f]{64}")
FOLDER_PREFIX_PATTERN = re.compile(
    r"(?:[A-Za-z]:)?[^,]*[/\\](?=[^/\\,]+\.[A-Za-z]\w*(?:,|$))"
)  # before a file


def skip_without_fit(
    build_blocks: Callable[[Fit], ReportBlocks],
) -> Callable[[ReportSources], ReportBlocks]:
    """What needs a calibration; nothing without one."""
    return lambda sources: build_blocks(sources.fit) if sources.fit else ()


REPORT_PAGES = (  # name, title, what it holds: after the page to sign
    ("budget", "Error budget", report_pages.build_budget_page),
    ("where", "Where the errors are", report_pages.build_error_location_page),
    ("parameters", "Parameters", report_pages.build_parameter_page),
)
APPENDIX_SECTIONS = (
    ("accuracy", "How large the errors are", report_appendix.build_error_distribution_blocks),
    ("joints", "What the errors go with", report_appendix.build_error_trend_blocks),
    (
        "correlations",
        "How the parameters hang together",
        skip_without_fit(report_appendix.build_correlation_blocks),
    ),
    (
        "iso9283",
        "Values by the formulas of ISO 9283",
        skip_without_fit(report_appendix.build_iso9283_blocks),
    ),
    ("solution", "How the fit was found", skip_without_fit(report_appendix.build_solution_blocks)),
    ("simulator", "The arm in the simulator", report_appendix.build_simulator_blocks),
)


class SignatureLine(NamedTuple):
    """A row to sign.  name: empty where it is written by hand."""

    role: str
    name: str


@dataclass(frozen=True)
class ReportRequest:
    """What the user says of a report, empty where nothing.

    date: of the report, ISO 8601.  facts: by the keys of `facts.FACTS`.  limits: what is required,
    claim_name: of which claim, inside or outside.  rung: of a diagnosis.
    deliver: by which deliverables.  appendix: whether it holds more than the four pages.
    """

    date: str
    title: str = ""
    customer: str = ""
    author: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)
    limits: tuple[ToleranceLimit, ...] = ()
    claim_name: str = "inside"
    rung: int | None = None
    deliver: tuple[str, ...] = ()
    appendix: bool = False

    def judge_sources(self, sources: ReportSources) -> ReportJudgement:
        """What the page judges.  Raises OptionError."""
        return judge_sources(sources, self.limits, self.claim_name, self.rung, self.deliver)


def build_report(
    sources: ReportSources, request: ReportRequest, judgement: ReportJudgement | None = None
) -> ReportDocument:
    """The whole report.  Raises CalibrationError for a part of a file that cannot be read.

    judgement: the judgement, where it was made already.
    """
    told = sources.provenance
    kind = list_named_results(sources)[0][0].capitalize()
    data = sources.results[0].data if not sources.relative else None
    facts = [("Robot", sources.robot), *list_labelled_facts(request.facts, data)]
    facts += (
        [("Customer", replace_invisible_and_bidi_characters(request.customer))]
        if request.customer
        else []
    )
    facts += [("Date of this report", request.date), ("Poses", describe_pose_counts(sources))]
    facts += [("Measurements", strip_folders(told.data) or "not named")]
    facts += [("SHA-256 of the measurements", told.data_sha256 or "not recorded")]
    judgement = judgement or request.judge_sources(sources)
    sheets = [
        ReportSection(
            "verdict", "Requirement and result", build_first_page_blocks(sources, judgement)
        )
    ]
    sheets += [
        ReportSection(name, title, tuple(made(sources))) for name, title, made in REPORT_PAGES
    ]
    more = [
        ReportSection(name, title, tuple(made(sources))) for name, title, made in APPENDIX_SECTIONS
    ]
    more += report_appendix.find_tables_not_shown(sources, [*sheets, *more])
    return ReportDocument(
        title=replace_invisible_and_bidi_characters(request.title) or f"{kind} of {sources.robot}",
        robot=sources.robot,
        facts=tuple(facts),
        signatures=list_signatures(
            replace_invisible_and_bidi_characters(request.author),
            replace_invisible_and_bidi_characters(request.customer),
        ),
        sections=join_pages_and_appendix(
            sheets, [*more, build_provenance_section(sources)], request.appendix
        ),
        digest=told.data_sha256 if SHA256_PATTERN.fullmatch(told.data_sha256) else "",
    )


def strip_folders(file_text: str) -> str:
    """Files without the folders of the machine; what is no file stays as it is."""
    return FOLDER_PREFIX_PATTERN.sub("", replace_invisible_and_bidi_characters(file_text))


def list_signatures(author: str, customer: str) -> tuple[SignatureLine, ...]:
    """Who signs: role, and name where it is known."""
    accepted = f"Accepted for {customer}" if customer else "Accepted"
    return (
        SignatureLine("Measured and evaluated", author),
        SignatureLine("Checked", ""),
        SignatureLine(accepted, ""),
    )


def describe_pose_counts(sources: ReportSources) -> str:
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


def build_provenance_section(sources: ReportSources) -> ReportSection:
    """Files, settings, versions and notices: what it takes to have the numbers again."""
    files: dict[tuple[str, str, str], None] = {}
    settings: list[Table] = []
    notices: list[ReportBlock] = []
    for kind, result in list_named_results(sources):
        told = result.provenance
        own = [(f.kind, strip_folders(f.path), f.digest) for f in sources.files if f.kind == kind]
        data = ("measurements", strip_folders(told.data), told.data_sha256 or "not recorded")
        files |= dict.fromkeys([*own, data])
        rows = [(name, format_setting(value)) for name, value in told.settings.items()]
        settings.append(Table.from_rows(f"Settings of the {kind}", rows, "setting | value"))
        versions = told.versions.items()
        settings.append(
            Table.from_rows(f"Versions used by the {kind}", versions, PACKAGE_TABLE_COLUMNS)
        )
        notices += [NoteBlock(f"{kind}: {notice}", "notice") for notice in result.notices]
    notices = notices or [build_text_note("The programs gave no notices.")]
    every = (
        Table.from_rows("Files", files, FILE_TABLE_COLUMNS),
        *drop_empty_tables(*settings),
        build_program_version_table(),
        *notices,
    )
    return ReportSection("provenance", "Provenance", every)


def build_program_version_table() -> Table:
    """The programs that made a report."""
    rows = ((name, version(name)) for name in ("minimax-cal", "plotly"))
    return Table.from_rows("This report was made by", rows, PACKAGE_TABLE_COLUMNS)


def format_setting(value: Any) -> str:
    """A setting as text."""
    if value is None:
        return "default"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key} = {part}" for key, part in value.items()) or "none"
    return str(value)

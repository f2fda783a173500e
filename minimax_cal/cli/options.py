"""What the commands share: options made from fields, and how results reach the terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from functools import cache, partial, reduce, wraps
from importlib.util import find_spec
from inspect import Parameter, signature
from math import inf, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import click
from click.core import ParameterSource
from rich.console import Console
from rich.text import Text

from minimax_cal.cli.command_group import HELP_ALL_FLAG, HELP_ALL_OPTION
from minimax_cal.cli.progress import show_stage_progress
from minimax_cal.cli.stderr_events import (
    PROGRESS_OPTION,
    UNREPORTED_FILE_KINDS,
    report_detected_file_kinds,
    report_error,
    report_event,
)
from minimax_cal.core.display_text import (
    escape_spreadsheet_formulas,
    replace_invisible_and_bidi_characters,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import (
    check_output_path,
    convert_to_plain_json,
    format_json,
    write_file_atomically,
)
from minimax_cal.core.option_fields import (
    SI_PER_OPTION_UNIT,
    Option,
    parse_low_high_range,
    split_comma_separated_names,
)
from minimax_cal.core.tables import Table
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from minimax_cal.fitting.pixels.options import PixelFiles
    from minimax_cal.instruments.instrument import Instrument
    from minimax_cal.measuring.measurements import Measurements
    from minimax_cal.reading.measurement_table import MeasurementTable

PIPED_OUTPUT_WIDTH = 110  # of text that goes to no terminal
MAX_FIRST_SCREEN_WIDTH = 80  # of a first screen, which any terminal can show
MAX_PRINTED_NOTICES = 50
MAX_NUMBER_OPTION = 1e12  # of any number: squares of what is larger overflow somewhere
RESULT_OPTION_GROUP = "Measurements and result"
MOST_USED_OPTION_GROUP = "What is used most"
MOST_USED_OPTIONS = {  # ten of each command with many options, by their names in Python
    "import": "joints columns units layout decimal leave_out mend preview as_json output",
    "calibrate": "objective effects only fix priors holdout instrument figure details output",
    "relative": "effects diagnose noises priors pixels joints camera board details output",
    "diagnose": "exclude instrument holdout quick jobs in_rows figure details as_json output",
    "plan": "poses tracker targets volume floor joints data fit details output",
    "compensate": "nominal frame tolerance most_change tool wobj lever safe_cells as_json output",
    "gap": "write fit diagnosis tip payload drive_gain ratio figure details output",
}
PICTURE_ENDINGS = (".png", ".svg", ".pdf")
LazyContent = Callable[[], Any] | None  # what is made where it is asked for
CallResult = TypeVar("CallResult")
CommandFunction = Callable[..., Any]
CommandDecorator = Callable[[CommandFunction], CommandFunction]

PATH_TYPE = click.Path(path_type=Path)
ROBOT_ARGUMENT = click.argument("robot")
DATA_ARGUMENT = click.argument("data", type=PATH_TYPE)
DATA_ARGUMENTS = click.argument("data", type=PATH_TYPE, nargs=-1, required=True)
OPTIONAL_DATA_ARGUMENTS = click.argument("data", type=PATH_TYPE, nargs=-1, metavar="[DATA...]")
OPTIONAL_DATA_ARGUMENT = click.argument("data", type=PATH_TYPE, required=False)
FIT_ARGUMENT = click.argument("fit", type=PATH_TYPE)
flag_option = partial(click.option, is_flag=True)
ROWS_IN_ORDER_OPTION = flag_option(
    "--rows-in-visit-order",
    "in_rows",
    help="Take the rows as the poses were visited, where the file tells no order.",
)


class SuggestedCommand(NamedTuple):
    """A command to go on with.  purpose: what it is for, a phrase."""

    purpose: str
    command: str


class OptionForm(NamedTuple):
    """How click reads an option.  to_si: from what is typed to SI."""

    click_type: Any
    shown_default: Any
    metavar: str
    to_si: Callable[[Any], Any]


class CameraAndOtherFiles(NamedTuple):
    """Files of cameras, and tables of the other data files."""

    camera_files: PixelFiles
    other_tables: list[MeasurementTable]


class RenamedOption(click.Option):
    """An option whose earlier spelling still works, and which help does not show."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Name and help, with the first spelling alone."""
        record = super().get_help_record(ctx)
        _, *earlier = self.opts
        return record and (record[0].replace(f", {', '.join(earlier)}", ""), record[1])


STEP_OPTION = click.option(
    "--step",
    "--rung",
    "rung",
    cls=RenamedOption,
    type=int,
    metavar="N",
    help="Use this step of a diagnosis: 0 nominal, 1 geometric, 2 ... with each effect [default: "
    "the last].",
)
JSON_OPTION = flag_option("--json", "as_json", help="Print JSON and nothing else on stdout.")
QUIET_FLAG_OPTION = flag_option("--quiet", "-q", help="Print no notices and no progress on stderr.")
DETAILS_OPTION = flag_option("--details", help="Print every table, not the first screen alone.")
SAFE_CELLS_OPTION = flag_option(
    "--safe-cells",
    help="Put an apostrophe before cells that a spreadsheet would run as a formula.",
)


# ---- options from fields and arguments ---------------------------------------------------------


def options_from_dataclass(
    dataclass_type: Any, *field_names: str, **option_changes: Any
) -> CommandDecorator:
    """Options of a command from the fields of a dataclass that are made by `option_field`.

    The command gets their values as keywords of the fields' names, in SI.  field_names: which
    fields. option_changes: what is not as there, as their group.
    """
    return combine_decorators(
        *(
            build_click_option(
                field.name, field.default, replace(field.metadata["option"], **option_changes)
            )
            for field in fields(dataclass_type)
            if "option" in field.metadata and (not field_names or field.name in field_names)
        )
    )


def take_option_record(
    dataclass_type: Callable[..., CallResult], option_values: dict[str, Any]
) -> CallResult:
    """A record of options; its values are removed from the option values of the command."""
    record_fields = fields(cast(Any, dataclass_type))
    names = [field.name for field in record_fields if field.name in option_values]
    return dataclass_type(**{name: option_values.pop(name) for name in names})


def options_given_on_command_line() -> set[str]:
    """Names of the options that the command line gives."""
    at = click.get_current_context()
    given = ParameterSource.COMMANDLINE
    return {name for name in at.params if at.get_parameter_source(name) is given}


def refuse_given_options(option_names: Iterable[str], reason: str) -> None:
    """Raise OptionError for an option on the command line that has no use, saying why."""
    for name in sorted(options_given_on_command_line() & {*option_names}):
        raise OptionError(f"{name}= {reason}: leave it out")


def options_from_parameters(
    function: Callable[..., object], group: str = "", /, **option_by_name: Option
) -> CommandDecorator:
    """Options of a command from arguments of a function, whose defaults are theirs, in SI.

    group: of those that tell none.
    """
    known = signature(function).parameters
    options = {
        name: replace(each, group=each.group or group) for name, each in option_by_name.items()
    }
    return combine_decorators(
        *(build_click_option(name, known[name].default, each) for name, each in options.items())
    )


def group_option(group: str, *names: str, **click_arguments: Any) -> CommandDecorator:
    """An option that is no field and no argument of a function."""
    return click.option(*names, cls=GroupedOption, group=group, **click_arguments)


def combine_decorators(*decorators: CommandDecorator) -> CommandDecorator:
    """Several decorators as one, the first on top."""
    return lambda command: reduce(lambda made, each: each(made), reversed(decorators), command)


QUIET_AND_PROGRESS_OPTIONS = combine_decorators(QUIET_FLAG_OPTION, PROGRESS_OPTION)


def build_click_option(name: str, default: Any, option: Option) -> CommandDecorator:
    """The click option of a field or argument, which is its default where it is not given."""
    spelt = option.flag or "--" + name.replace("_", "-")
    kind, shown, metavar, read = option_type_and_conversion(default, option, name)

    def in_si(_: click.Context, __: click.Parameter, given: Any) -> Any:
        if option.many:
            return option.many(
                map(read, given) if option.read else split_comma_separated_names(given)
            )
        if isinstance(given, float) and (isnan(given) or MAX_NUMBER_OPTION < abs(given) < inf):
            raise click.BadParameter(
                f"{given:g} cannot be; give a finite number, at most {MAX_NUMBER_OPTION:g}"
            )
        return default if given is None else read(given)

    return click.option(
        spelt,
        name,
        cls=GroupedOption,
        group=option.group,
        type=kind,
        is_flag=kind is bool,
        **({"required": True} if default is Parameter.empty else {"default": shown}),
        show_default=shown is not None and kind is not bool,
        metavar=option.metavar or metavar or None,
        nargs=option.values,
        multiple=option.many is not None,
        callback=in_si,
        help=option.help or None,
        hidden=option.hidden,
    )


class GroupedOption(click.Option):
    """An option that the help lists under a heading."""

    def __init__(self, *given: Any, group: str = "", **more: Any) -> None:
        super().__init__(*given, **more)
        self.group = group


class CommandWithGroupedHelp(click.Command):
    """A command whose help lists the options that are used most, or with --help-all every one."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The options under their headings, in the order in which these come first."""
        first = dict.fromkeys(MOST_USED_OPTIONS.get(self.name or "", "").split(), ("", ""))
        groups: dict[str, list[tuple[str, str]]] = {MOST_USED_OPTION_GROUP: []}
        for each in self.get_params(ctx):
            title = getattr(each, "group", "") or RESULT_OPTION_GROUP
            record = each.get_help_record(ctx) if isinstance(each, click.Option) else None
            if record and each.name in first:
                groups.setdefault(title, [])
                first[each.name] = record
            elif record:
                groups.setdefault(title, []).append(record)
        groups[MOST_USED_OPTION_GROUP] += first.values()
        last = groups.pop(RESULT_OPTION_GROUP, [])
        some = first and not ctx.meta.get(HELP_ALL_FLAG)
        for title, records in (*groups.items(), (RESULT_OPTION_GROUP, last)):
            if records and (title == MOST_USED_OPTION_GROUP or not some):
                with formatter.section(title):
                    formatter.write_dl(records)
        if some:
            formatter.write(f"\nEvery option: {ctx.command_path} {HELP_ALL_FLAG}\n")


def option_type_and_conversion(default: Any, option: Option, name: str) -> OptionForm:
    """How click reads an option, from its default, unit and reader."""
    scale = SI_PER_OPTION_UNIT[option.unit]
    if option.read is Path:
        return OptionForm(PATH_TYPE, None, "", Path)
    if isinstance(default, tuple) and default:
        low, high = (f"{end / scale:g}" for end in default)
        return OptionForm(
            str,
            f"{low}:{high}",
            "LOW:HIGH",
            lambda text: parse_low_high_range(text, name, scale),
        )
    if option.unit or isinstance(default, float):
        shown = None if default is None or isnan(default) else round(default / scale, 9)
        return OptionForm(float, shown, option.unit.upper(), lambda value: value * scale)
    if isinstance(default, bool | int | str) and default != "":
        return OptionForm(type(default), default, "", option.read or type(default))
    return OptionForm(str, None, "", option.read or (tuple if option.values > 1 else str))


def define_command(function: CommandFunction) -> click.Command:
    """A command of the name that its function has before _command."""
    named = function.__name__.removesuffix("_command")
    return click.command(name=named, cls=CommandWithGroupedHelp)(HELP_ALL_OPTION(function))


NAMED_ARGUMENT_PATTERN = re.compile(r"(?<![\w-])(\w+)=(?:True\b|'([^']*)')?(?=(\S?))")

OPTION_VALUE_START_PATTERN = re.compile(r"--[\w-]+ \Z")  # what follows is the value of an option


def replace_arguments_by_flags(message: str, command: click.Command) -> str:
    """A message of Python, which calls an argument name=, with the command's --name."""
    flags = {p.name: max(p.opts, key=len) for p in command.params if isinstance(p, click.Option)}

    def in_flag(found: re.Match[str]) -> str:
        flag, value = flags.get(found[1]), found[2]
        if flag is None or OPTION_VALUE_START_PATTERN.search(message, 0, found.start()):
            return found[0]
        return flag if value is None and found[3] in ",.;:)" else f"{flag} {value or ''}"

    return NAMED_ARGUMENT_PATTERN.sub(in_flag, message)


def replace_arguments_by_current_flags(message: str) -> str:
    """A message of Python as the command says it that is at work."""
    at = click.get_current_context(silent=True)
    return replace_arguments_by_flags(message, at.command) if at else message


# ---- results -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class CommandOutput:
    """Where a result goes, as --json, --output, --figure, --quiet and --details say.

    keep: what its file is called in advice; empty for a command without a first screen.
    """

    output: Path | None = None
    as_json: bool = False
    figure: Path | None = None
    quiet: bool = False
    details: bool = False
    keep: str = ""

    def with_outputs_by_file_ending(self, *, can_write_csv: bool, can_draw: bool) -> CommandOutput:
        """With result and picture in the files whose ending says so, as .json or .svg.

        Raises OptionError for a picture of a command that draws none, or for two of a kind.
        """
        output, ending = self.output, self.output.suffix.lower() if self.output else ""
        if ending in PICTURE_ENDINGS:
            if not can_draw:
                raise OptionError(f"{output}: this command draws no picture; write a .json")
            if self.figure:
                raise OptionError(f"{output}: the picture goes to {self.figure} already")
            return replace(self, output=None, figure=output)
        if ending == ".csv" and not can_write_csv:
            raise OptionError(f"{output}: this command writes no CSV; write a .json")
        if self.figure and self.figure.suffix.lower() == ".json" and not output:
            return replace(self, output=self.figure, figure=None)
        return self

    def open_stage_callback(self) -> AbstractContextManager[Callable[[str], None]]:
        """A callback for each stage of long work, which stderr shows."""
        return show_stage_progress(self.quiet)

    def call_with_progress(
        self, function: Callable[..., CallResult], *arguments: Any, **options: Any
    ) -> CallResult:
        """What a function makes that takes long, its progress on stderr."""
        with self.open_stage_callback() as progress:
            return function(*arguments, progress=progress, **options)

    def print_notices(self, *texts: str) -> None:
        """Print notices on stderr, one a line, and before them what files were taken for."""
        report_detected_file_kinds()
        shown = () if self.quiet else texts[:MAX_PRINTED_NOTICES]
        for text in shown:
            report_event("notice", replace_arguments_by_current_flags(text))
        if shown and len(texts) > MAX_PRINTED_NOTICES:
            report_event("notice", f"and {len(texts) - MAX_PRINTED_NOTICES} more, in the JSON")

    def check_no_figure_requested(self) -> None:
        """Raise OptionError where a picture is asked for and there is none."""
        if self.figure:
            raise OptionError(
                f"{self.figure}: a picture is of points of a tracker alone; write a .json"
            )

    def remember_file_kinds(self, *sources: tuple[str, str]) -> None:
        """Store what each file holds, so that stderr says it before the first other line."""
        if not self.quiet:
            UNREPORTED_FILE_KINDS.set([f"{source} holds {what}" for source, what in sources])

    def escape_formula_cells(self, csv_text: str, is_escaping: bool) -> str:
        """CSV that holds text of its input; what a spreadsheet would run is said, or made safe."""
        quoted, count = escape_spreadsheet_formulas(csv_text)
        if count and not is_escaping:
            self.print_notices(
                f"{count} cells begin as a formula does, which a spreadsheet would run; "
                "--safe-cells puts an apostrophe before them"
            )
        return quoted if is_escaping else csv_text

    def report_written_files(self, *paths: Path | str | None, **more: str) -> None:
        """Say on stderr which files were written, whatever their names.  more: for programs."""
        for path in paths:
            if path and not self.quiet:
                report_event("written", str(path), **more)

    def write_result_or_print_json(
        self,
        make_json: Callable[[], str],
        status: Status = Status.CONVERGED,
        make_file_json: LazyContent = None,
        make_csv: LazyContent = None,
    ) -> bool:
        """Write a result where it was asked for; whether people want to read it too.

        make_file_json: the JSON of its file, where it is another.  make_csv: its CSV, which a file
        gets unless its ending asks for JSON.  A result that failed is not written to a file.
        """
        once = cache(make_json)
        if self.output and status is not Status.FAILED:
            made = (
                make_csv
                if make_csv and self.output.suffix.lower() != ".json"
                else make_file_json or once
            )
            write_file_atomically(self.output, made())
            self.report_written_files(self.output)
        if self.as_json:
            click.echo(once(), nl=False)
        return not self.as_json

    def write_and_print_result(
        self,
        result: Any,
        *,
        status: Status = Status.CONVERGED,
        reason: str = "",
        notices: Iterable[str] | None = None,
        json: LazyContent = None,
        file: LazyContent = None,
        rows: LazyContent = None,
        show: LazyContent = None,
        draw: Callable[[Any, Path], object] | None = None,
        **screen: Any,
    ) -> int:
        """Say, write, show and draw a `Result` as it was asked for; the exit code.

        status, reason: how it ended and why.  notices, json, show: its own unless given. file,
        rows: as of `write_result_or_print_json`.  draw: saves its picture.  screen: as of
        `print_result_tables`; after a failure nothing is advised but its mend, which the sentences
        hold.
        """
        if status is not Status.CONVERGED:
            screen["advice"] = ()
        said = result.notices if notices is None else notices
        self.print_notices(*(text for text in said if text != reason))
        if self.write_result_or_print_json(json or result.json, status, file, rows):
            (show or partial(self.print_result_tables, result, **screen))()
        if self.figure and draw:
            draw(result, self.figure)
            self.report_written_files(self.figure)
        return report_status_as_exit_code(status, reason)

    def print_result_tables(
        self,
        result: Any,
        *,
        sentences: Sequence[str] = (),
        more: Sequence[Table] = (),
        tables: LazyContent = None,
        advice: Iterable[SuggestedCommand] | None = None,
    ) -> None:
        """Print the first screen of a result, or with --details its sentences and every table.

        Every table alone where it has no first screen.
        sentences, tables, advice: other than its own, and how to keep it.  more: tables beside it.
        """
        sentences = [
            replace_arguments_by_current_flags(text) for text in sentences or [result.headline()]
        ]
        if self.details:
            open_stdout_console().print(
                Text(replace_invisible_and_bidi_characters(" ".join(sentences)))
            )
            click.echo()
        if self.details or not self.keep:
            print_tables(*(tables or result.tables)(), *more)
            return
        whole = Console(highlight=False)
        width = (
            min(whole.width, MAX_FIRST_SCREEN_WIDTH)
            if whole.is_terminal
            else MAX_FIRST_SCREEN_WIDTH
        )
        console = Console(highlight=False, width=width)
        for sentence in sentences:
            console.print(Text(replace_invisible_and_bidi_characters(sentence)))
        click.echo()
        for table in (*result.first_tables(), *more):
            table.print_to_console(console)
        for purpose, line in self.suggest_keeping_result() if advice is None else advice:
            console.print(Text(replace_invisible_and_bidi_characters(f"{purpose}:")))
            whole.print(
                Text(replace_invisible_and_bidi_characters(f"  {line}")), soft_wrap=True
            )  # to be copied in one piece

    def suggest_keeping_result(self) -> list[SuggestedCommand]:
        """Suggest how to keep a result that was not written, and how to see every table."""
        if self.output:
            return [SuggestedCommand("To see every table", "add --details")]
        return [
            SuggestedCommand(
                "To keep the result, and to see every table", f"add -o {self.keep} --details"
            )
        ]


def pass_output_to_command(
    *, can_write_csv: bool = False, can_draw: bool = False, suggested_file_name: str = ""
) -> CommandDecorator:
    """Hand a command its `CommandOutput` as `output`, once its files are known to be writable.

    can_write_csv: its result may be a CSV.  can_draw: or a picture.  suggested_file_name: as of
    `CommandOutput`.
    """

    def made(command: CommandFunction) -> CommandFunction:
        @wraps(command)
        def handed(*given: Any, **named: Any) -> Any:
            to = replace(
                take_option_record(CommandOutput, named), keep=suggested_file_name
            ).with_outputs_by_file_ending(can_write_csv=can_write_csv, can_draw=can_draw)
            check_writable_paths(to.output)
            check_drawable_path(to.figure)
            return command(*given, to=to, **named)

        return handed

    return made


def read_measured_points(paths: Sequence[Path], rows_in_visit_order: bool) -> Measurements:
    """The measurements of a file, or of several as sessions.

    rows_in_visit_order: visited row by row, where they tell no order.
    """
    from minimax_cal.measuring.campaigns import read_campaigns

    return set_visit_order_by_rows(read_campaigns(paths), rows_in_visit_order)


def set_visit_order_by_rows(measurements: Measurements, rows_in_visit_order: bool) -> Measurements:
    """Measurements as they are, or visited row by row where they tell no order."""
    from minimax_cal.measuring.visit_history import has_visit_order

    return (
        measurements.in_visit_order()
        if rows_in_visit_order and not has_visit_order(measurements)
        else measurements
    )


def read_any_measurements(
    files: Sequence[Path | MeasurementTable], rows_in_visit_order: bool, output: CommandOutput
) -> Measurements | list[Instrument]:
    """`read_measured_points` of trackers, or what else the files hold; stderr says what each was
    taken for.
    """
    from minimax_cal.instruments.instrument_files import read_instruments_or_measurements

    data = read_instruments_or_measurements(files)
    if isinstance(data, list):
        output.remember_file_kinds(
            *((one.at.source, f"{one.kind} at {one.poses} poses") for one in data)
        )
        return data
    seen, joints = f"points at {data.poses} poses", data.origins[0].joints if data.origins else ""
    if joints:
        output.remember_file_kinds(
            (" + ".join(data.origins[0].points), seen), (joints, "their joint values")
        )
    else:
        output.remember_file_kinds((data.source, seen))
    return set_visit_order_by_rows(data, rows_in_visit_order)


def split_camera_files(
    data_paths: Sequence[Path], option_values: dict[str, Any]
) -> CameraAndOtherFiles:
    """Split camera files, given by options or among the data files, from the other data files.

    option_values: options of a command, which `PixelFiles` are taken from.  Raises OptionError.
    """
    from minimax_cal.fitting.pixels.options import CAMERA_OPTION_NAMES, PixelFiles
    from minimax_cal.reading.measurement_table import read_measurement_table

    files = take_option_record(PixelFiles, option_values)
    if not (data_paths or files.is_given):
        raise click.UsageError(
            "Missing argument 'DATA...', or --pixels with --joints and --camera."
        )
    if not files.is_given:
        refuse_given_options(
            CAMERA_OPTION_NAMES, "is about what cameras see, with pixels=, joints= and camera="
        )
    return CameraAndOtherFiles(
        *files.find_in_data([read_measurement_table(path) for path in data_paths])
    )


def run_on_any_instruments(
    function: Callable[..., Any],
    robot: str,
    measurement_sets: Sequence[Any],
    camera_files: PixelFiles,
    output: CommandOutput,
    option_values: dict[str, Any],
) -> int:
    """What a verb says of data of any instruments, and of what cameras saw; the exit code."""
    from minimax_cal.fitting.pixels.image_instrument import read_detections

    output.check_no_figure_requested()
    seen = [read_detections(*camera_files.paths())] if camera_files.is_given else []
    found = output.call_with_progress(function, robot, [*measurement_sets, *seen], **option_values)
    return output.write_and_print_result(found, status=found.status, reason=found.reason)


def build_result_options(
    written_content: str, *, suggested_file_name: str = "", drawn_content: str = ""
) -> CommandDecorator:
    """The options of a result.

    written_content: what -o writes.  suggested_file_name: what its file is called in advice, where
    --details shows more than a first screen.  drawn_content: what --figure draws, if anything.
    """
    rows, draws = "CSV" in written_content, bool(drawn_content)
    ends = f"{'.csv or ' * rows}.json{', or the picture to a .png, .svg or .pdf' * draws},"
    drawn = click.option(
        "--figure", type=PATH_TYPE, help=f"Draw {drawn_content} to this PNG, SVG or PDF."
    )
    told = (JSON_OPTION, output_option(f"{written_content}, {ends}"), QUIET_AND_PROGRESS_OPTIONS)
    more = (*[DETAILS_OPTION] * bool(suggested_file_name), *[drawn] * draws)
    return combine_decorators(
        *more,
        *told,
        pass_output_to_command(
            can_write_csv=rows, can_draw=draws, suggested_file_name=suggested_file_name
        ),
    )


def output_option(written_content: str) -> CommandDecorator:
    """The option -o."""
    return click.option(
        "-o", "--output", type=PATH_TYPE, help=f"Write {written_content} to this file."
    )


def open_stdout_console() -> Console:
    """Stdout, as wide as the terminal, or 110 columns elsewhere."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PIPED_OUTPUT_WIDTH)


def print_tables(*tables: Table, headline: str = "") -> None:
    """Print what tables come to on stdout, and the tables."""
    console = open_stdout_console()
    if headline:
        console.print(
            Text(replace_invisible_and_bidi_characters(headline)), soft_wrap=not console.is_terminal
        )
        click.echo()
    for table in tables:
        table.print_to_console(console)


def check_writable_paths(*paths: Path | None) -> None:
    """Raise an error, before any work, for an output that cannot be written."""
    for path in paths:
        if path:
            check_output_path(path)


def check_drawable_path(path: Path | None) -> None:
    """Raise an error, before any work, for a picture that cannot be drawn."""
    if path:
        from minimax_cal.reporting.plots.error_figure import (
            MATPLOTLIB_NEEDED_MESSAGE,
            PICTURE_SUFFIXES,
        )

        check_output_path(path, PICTURE_SUFFIXES)
        if find_spec("matplotlib") is None:
            raise OptionError(MATPLOTLIB_NEEDED_MESSAGE)


def report_status_as_exit_code(status: Status, reason: str = "") -> int:
    """Of how the numbers ended, with a line of error where they did not work out.

    reason: why, of this result; the advice for all such results unless given.
    """
    if status is Status.CONVERGED:
        return 0
    return report_error(f"{status}: {replace_arguments_by_current_flags(reason) or status.advice}")


def print_json_or_tables(as_json: bool, content: object, *tables: Table) -> int:
    """Print JSON, or tables; the exit code."""
    if as_json:
        click.echo(format_json(convert_to_plain_json(content)), nl=False)
    else:
        print_tables(*tables)
    return 0

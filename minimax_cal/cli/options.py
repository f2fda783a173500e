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
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource
from rich.console import Console
from rich.text import Text

from minimax_cal.cli.commands import WHOLE, WHOLE_HELP
from minimax_cal.cli.progress import stages
from minimax_cal.cli.stderr import PROGRESS, TAKEN, complain, tell, tell_taken
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, json_text, plain, write_whole
from minimax_cal.ground.options import SI, Option, names_of, pair
from minimax_cal.ground.tables import Table
from minimax_cal.ground.words import visible, without_formulas
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from minimax_cal.fitting.pixels.options import PixelFiles
    from minimax_cal.instruments.instrument import Instrument
    from minimax_cal.measuring.measurements import Measurements
    from minimax_cal.reading.rows import Rows

WIDTH = 110  # of text that goes to no terminal
FIRST_WIDTH = 80  # of a first screen, which any terminal can show
MOST_NOTICES = 50
MOST = 1e12  # of any number: squares of what is larger overflow somewhere
RESULT = "Measurements and result"
FIRST = "What is used most"
MOST_USED = {  # ten of each command with many options, by their names in Python
    "import": "joints columns units layout decimal leave_out mend preview as_json output",
    "calibrate": "objective effects only fix priors holdout instrument figure details output",
    "relative": "effects diagnose noises priors pixels joints camera board details output",
    "diagnose": "exclude instrument holdout quick jobs in_rows figure details as_json output",
    "plan": "poses tracker targets volume floor joints data fit details output",
    "compensate": "nominal frame tolerance most_change tool wobj lever safe_cells as_json output",
    "gap": "write fit diagnosis tip payload drive_gain ratio figure details output",
}
DRAWN = (".png", ".svg", ".pdf")
Advice = Iterable[tuple[str, str]]  # what for, and the command
Lazy = Callable[[], Any] | None  # what is made where it is asked for
Made = TypeVar("Made")
Command = Callable[..., Any]
Decorator = Callable[[Command], Command]

PATH = click.Path(path_type=Path)
ROBOT = click.argument("robot")
DATA = click.argument("data", type=PATH)
CAMPAIGNS = click.argument("data", type=PATH, nargs=-1, required=True)
SOME_CAMPAIGNS = click.argument("data", type=PATH, nargs=-1, metavar="[DATA...]")
SOME_DATA = click.argument("data", type=PATH, required=False)
FIT = click.argument("fit", type=PATH)
flag = partial(click.option, is_flag=True)
ROWS = flag(
    "--rows-in-visit-order",
    "in_rows",
    help="Take the rows as the poses were visited, where the file tells no order.",
)


class Renamed(click.Option):
    """An option whose earlier spelling still works, and which help does not show."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Name and help, with the first spelling alone."""
        record = super().get_help_record(ctx)
        _, *earlier = self.opts
        return record and (record[0].replace(f", {', '.join(earlier)}", ""), record[1])


RUNG = click.option(
    "--step",
    "--rung",
    "rung",
    cls=Renamed,
    type=int,
    metavar="N",
    help="Use this step of a diagnosis: 0 nominal, 1 geometric, 2 ... with each effect [default: "
    "the last].",
)
JSON = flag("--json", "as_json", help="Print JSON and nothing else on stdout.")
NO_NOTICES = flag("--quiet", "-q", help="Print no notices and no progress on stderr.")
DETAILS = flag("--details", help="Print every table, not the first screen alone.")
SAFE_CELLS = flag(
    "--safe-cells",
    help="Put an apostrophe before cells that a spreadsheet would run as a formula.",
)


# ---- options from fields and arguments ---------------------------------------------------------


def options_from(kind: Any, *names: str, **other: Any) -> Decorator:
    """Options of a command from the fields of a dataclass that are made by `ground.options.option`.

    The command gets their values as keywords of the fields' names, in SI.  names: which fields.
    other: what is not as there, as their group.
    """
    return stacked(
        *(
            option_of(field.name, field.default, replace(field.metadata["option"], **other))
            for field in fields(kind)
            if "option" in field.metadata and (not names or field.name in names)
        )
    )


def record_of(kind: Callable[..., Made], chosen: dict[str, Any]) -> Made:
    """A record of options, from what a command got; they are taken from there."""
    told: Any = kind
    return kind(**{one.name: chosen.pop(one.name) for one in fields(told) if one.name in chosen})


def on_command_line() -> set[str]:
    """Names of the options that the command line gives."""
    at = click.get_current_context()
    given = ParameterSource.COMMANDLINE
    return {name for name in at.params if at.get_parameter_source(name) is given}


def refuse(names: Iterable[str], why: str) -> None:
    """Raise OptionError for an option on the command line that has no use, saying why."""
    for name in sorted(on_command_line() & {*names}):
        raise OptionError(f"{name}= {why}: leave it out")


def options_of(verb: Callable[..., object], group: str = "", /, **told: Option) -> Decorator:
    """Options of a command from arguments of a function, whose defaults are theirs, in SI.

    group: of those that tell none.
    """
    known = signature(verb).parameters
    options = {name: replace(each, group=each.group or group) for name, each in told.items()}
    return stacked(*(option_of(name, known[name].default, each) for name, each in options.items()))


def plain_option(group: str, *names: str, **more: Any) -> Decorator:
    """An option that is no field and no argument of a function."""
    return click.option(*names, cls=Grouped, group=group, **more)


def stacked(*decorators: Decorator) -> Decorator:
    """Several decorators as one, the first on top."""
    return lambda command: reduce(lambda made, each: each(made), reversed(decorators), command)


QUIET = stacked(NO_NOTICES, PROGRESS)


def option_of(name: str, default: Any, told: Option) -> Decorator:
    """The click option of a field or argument, which is its default where it is not given."""
    spelt = told.flag or "--" + name.replace("_", "-")
    kind, shown, metavar, read = kind_of(default, told, name)

    def in_si(_: click.Context, __: click.Parameter, given: Any) -> Any:
        if told.many:
            return told.many(map(read, given) if told.read else names_of(given))
        if isinstance(given, float) and (isnan(given) or MOST < abs(given) < inf):
            raise click.BadParameter(f"{given:g} cannot be; give a finite number, at most {MOST:g}")
        return default if given is None else read(given)

    return click.option(
        spelt,
        name,
        cls=Grouped,
        group=told.group,
        type=kind,
        is_flag=kind is bool,
        **({"required": True} if default is Parameter.empty else {"default": shown}),
        show_default=shown is not None and kind is not bool,
        metavar=told.metavar or metavar or None,
        nargs=told.values,
        multiple=told.many is not None,
        callback=in_si,
        help=told.help or None,
        hidden=told.hidden,
    )


class Grouped(click.Option):
    """An option that the help lists under a heading."""

    def __init__(self, *given: Any, group: str = "", **more: Any) -> None:
        super().__init__(*given, **more)
        self.group = group


class InGroups(click.Command):
    """A command whose help lists the options that are used most, or with --help-all every one."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The options under their headings, in the order in which these come first."""
        first = dict.fromkeys(MOST_USED.get(self.name or "", "").split(), ("", ""))
        groups: dict[str, list[tuple[str, str]]] = {FIRST: []}
        for each in self.get_params(ctx):
            title = getattr(each, "group", "") or RESULT
            record = each.get_help_record(ctx) if isinstance(each, click.Option) else None
            if record and each.name in first:
                groups.setdefault(title, [])
                first[each.name] = record
            elif record:
                groups.setdefault(title, []).append(record)
        groups[FIRST] += first.values()
        last = groups.pop(RESULT, [])
        some = first and not ctx.meta.get(WHOLE)
        for title, records in (*groups.items(), (RESULT, last)):
            if records and (title == FIRST or not some):
                with formatter.section(title):
                    formatter.write_dl(records)
        if some:
            formatter.write(f"\nEvery option: {ctx.command_path} {WHOLE}\n")


def kind_of(default: Any, told: Option, name: str) -> tuple[Any, Any, str, Callable[[Any], Any]]:
    """Type of what people give, its default and metavar, and what it is in SI."""
    scale = SI[told.unit]
    if told.read is Path:
        return PATH, None, "", Path
    if isinstance(default, tuple) and default:
        low, high = (f"{end / scale:g}" for end in default)
        return str, f"{low}:{high}", "LOW:HIGH", lambda text: pair(text, name, scale)
    if told.unit or isinstance(default, float):
        shown = None if default is None or isnan(default) else round(default / scale, 9)
        return float, shown, told.unit.upper(), lambda value: value * scale
    if isinstance(default, bool | int | str) and default != "":
        return type(default), default, "", told.read or type(default)
    return str, None, "", told.read or (tuple if told.values > 1 else str)


def command(made: Command) -> click.Command:
    """A command of the name that its function has before _command."""
    named = made.__name__.removesuffix("_command")
    return click.command(name=named, cls=InGroups)(WHOLE_HELP(made))


NAMED = re.compile(r"(?<![\w-])(\w+)=(?:True\b|'([^']*)')?(?=(\S?))")

VALUED = re.compile(r"--[\w-]+ \Z")  # what follows is the value of an option


def in_flags(text: str, command: click.Command) -> str:
    """A message of Python, which calls an argument name=, with the command's --name."""
    flags = {p.name: max(p.opts, key=len) for p in command.params if isinstance(p, click.Option)}

    def in_flag(found: re.Match[str]) -> str:
        flag, value = flags.get(found[1]), found[2]
        if flag is None or VALUED.search(text, 0, found.start()):
            return found[0]
        return flag if value is None and found[3] in ",.;:)" else f"{flag} {value or ''}"

    return NAMED.sub(in_flag, text)


def flagged(text: str) -> str:
    """A message of Python as the command says it that is at work."""
    at = click.get_current_context(silent=True)
    return in_flags(text, at.command) if at else text


# ---- results -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Output:
    """Where a result goes, as --json, --output, --figure, --quiet and --details say.

    keep: what its file is called in advice; empty for a command without a first screen.
    """

    output: Path | None = None
    as_json: bool = False
    figure: Path | None = None
    quiet: bool = False
    details: bool = False
    keep: str = ""

    def by_ending(self, *, rows: bool, draws: bool) -> Output:
        """With result and picture in the files whose ending says so, as .json or .svg.

        Raises OptionError for a picture of a command that draws none, or for two of a kind.
        """
        output, ending = self.output, self.output.suffix.lower() if self.output else ""
        if ending in DRAWN:
            if not draws:
                raise OptionError(f"{output}: this command draws no picture; write a .json")
            if self.figure:
                raise OptionError(f"{output}: the picture goes to {self.figure} already")
            return replace(self, output=None, figure=output)
        if ending == ".csv" and not rows:
            raise OptionError(f"{output}: this command writes no CSV; write a .json")
        if self.figure and self.figure.suffix.lower() == ".json" and not output:
            return replace(self, output=self.figure, figure=None)
        return self

    def stages(self) -> AbstractContextManager[Callable[[str], None]]:
        """A callback for each stage of long work, which stderr shows."""
        return stages(self.quiet)

    def work(self, verb: Callable[..., Made], *given: Any, **chosen: Any) -> Made:
        """What a function makes that takes long, its progress on stderr."""
        with self.stages() as progress:
            return verb(*given, progress=progress, **chosen)

    def notice(self, *texts: str) -> None:
        """Print notices on stderr, one a line, and before them what files were taken for."""
        tell_taken()
        shown = () if self.quiet else texts[:MOST_NOTICES]
        for text in shown:
            tell("notice", flagged(text))
        if shown and len(texts) > MOST_NOTICES:
            tell("notice", f"and {len(texts) - MOST_NOTICES} more, in the JSON")

    def undrawn(self) -> None:
        """Raise OptionError where a picture is asked for and there is none."""
        if self.figure:
            raise OptionError(
                f"{self.figure}: a picture is of points of a tracker alone; write a .json"
            )

    def took(self, *sources: tuple[str, str]) -> None:
        """Say on stderr what files were taken for, once the work comes to something."""
        if not self.quiet:
            TAKEN.set([f"{source} holds {what}" for source, what in sources])

    def cells(self, text: str, safe: bool) -> str:
        """CSV that holds text of its input; what a spreadsheet would run is said, or made safe."""
        quoted, count = without_formulas(text)
        if count and not safe:
            self.notice(
                f"{count} cells begin as a formula does, which a spreadsheet would run; "
                "--safe-cells puts an apostrophe before them"
            )
        return quoted if safe else text

    def wrote(self, *paths: Path | str | None, **more: str) -> None:
        """Say on stderr which files were written, whatever their names.  more: for programs."""
        for path in paths:
            if path and not self.quiet:
                tell("written", str(path), **more)

    def deliver(
        self,
        json: Callable[[], str],
        status: Status = Status.CONVERGED,
        file: Lazy = None,
        rows: Lazy = None,
    ) -> bool:
        """Write a result where it was asked for; whether people want to read it too.

        file: the JSON of its file, where it is another.  rows: its CSV, which a file gets unless
        its ending asks for JSON.  A result that failed is not written to a file.
        """
        once = cache(json)
        if self.output and status is not Status.FAILED:
            made = rows if rows and self.output.suffix.lower() != ".json" else file or once
            write_whole(self.output, made())
            self.wrote(self.output)
        if self.as_json:
            click.echo(once(), nl=False)
        return not self.as_json

    def finish(
        self,
        found: Any,
        *,
        status: Status = Status.CONVERGED,
        reason: str = "",
        notices: Iterable[str] | None = None,
        json: Lazy = None,
        file: Lazy = None,
        rows: Lazy = None,
        show: Lazy = None,
        draw: Callable[[Any, Path], object] | None = None,
        **screen: Any,
    ) -> int:
        """Say, write, show and draw a `Result` as it was asked for; the exit code.

        status, reason: how it ended and why.  notices, json, show: its own unless given.
        file, rows: as of `deliver`.  draw: saves its picture.  screen: as of `present`; after a
        failure nothing is advised but its mend, which the sentences hold.
        """
        if status is Status.FAILED:
            screen["advice"] = ()
        said = found.notices if notices is None else notices
        self.notice(*(text for text in said if text != reason))
        if self.deliver(json or found.json, status, file, rows):
            (show or partial(self.present, found, **screen))()
        if self.figure and draw:
            draw(found, self.figure)
            self.wrote(self.figure)
        return exit_code(status, reason)

    def present(
        self,
        found: Any,
        *,
        sentences: Sequence[str] = (),
        more: Sequence[Table] = (),
        tables: Lazy = None,
        advice: Advice | None = None,
    ) -> None:
        """Print the first screen of a result, or with --details its sentences and every table.

        Every table alone where it has no first screen.
        sentences, tables, advice: other than its own, and how to keep it.  more: tables beside it.
        """
        sentences = [flagged(text) for text in sentences or [found.headline()]]
        if self.details:
            terminal().print(Text(visible(" ".join(sentences))))
            click.echo()
        if self.details or not self.keep:
            show(*(tables or found.tables)(), *more)
            return
        whole = Console(highlight=False)
        width = min(whole.width, FIRST_WIDTH) if whole.is_terminal else FIRST_WIDTH
        console = Console(highlight=False, width=width)
        for sentence in sentences:
            console.print(Text(visible(sentence)))
        click.echo()
        for table in (*found.first_tables(), *more):
            table.show(console)
        for purpose, line in self.kept() if advice is None else advice:
            console.print(Text(visible(f"{purpose}:")))
            whole.print(Text(visible(f"  {line}")), soft_wrap=True)  # to be copied in one piece

    def kept(self) -> Advice:
        """How to see every table, and to keep a result that was not written."""
        if self.output:
            return [("To see every table", "add --details")]
        return [("To keep the result, and to see every table", f"add -o {self.keep} --details")]


def with_output(*, rows: bool = False, draws: bool = False, keep: str = "") -> Decorator:
    """Hand a command its `Output` as `to`, once its files are known to be writable.

    rows: its result may be a CSV.  draws: or a picture.  keep: as of `Output`.
    """

    def made(command: Command) -> Command:
        @wraps(command)
        def handed(*given: Any, **named: Any) -> Any:
            to = replace(record_of(Output, named), keep=keep).by_ending(rows=rows, draws=draws)
            writable(to.output)
            drawable(to.figure)
            return command(*given, to=to, **named)

        return handed

    return made


def measured(paths: Sequence[Path], in_rows: bool) -> Measurements:
    """The measurements of a file, or of several as sessions.

    in_rows: visited row by row, where they tell no order.
    """
    from minimax_cal.measuring.campaigns import read_campaigns

    return visited(read_campaigns(paths), in_rows)


def visited(data: Measurements, in_rows: bool) -> Measurements:
    """Measurements as they are, or visited row by row where they tell no order."""
    from minimax_cal.measuring.history import ordered

    return data.in_visit_order() if in_rows and not ordered(data) else data


def of_any(
    files: Sequence[Path | Rows], in_rows: bool, to: Output
) -> Measurements | list[Instrument]:
    """`measured` of trackers, or what else the files hold; stderr says what each was taken for."""
    from minimax_cal.instruments.file import taken

    data = taken(files)
    if isinstance(data, list):
        to.took(*((one.at.source, f"{one.kind} at {one.poses} poses") for one in data))
        return data
    seen, joints = f"points at {data.poses} poses", data.origins[0].joints if data.origins else ""
    if joints:
        to.took((" + ".join(data.origins[0].points), seen), (joints, "their joint values"))
    else:
        to.took((data.source, seen))
    return visited(data, in_rows)


def among(data: Sequence[Path], chosen: dict[str, Any]) -> tuple[PixelFiles, list[Rows]]:
    """What is given of cameras, by options or among the files of data, and the other files.

    chosen: options of a command, which `PixelFiles` are taken from.  Raises OptionError.
    """
    from minimax_cal.fitting.pixels.options import OF_CAMERAS, PixelFiles
    from minimax_cal.reading.rows import read_rows

    files = record_of(PixelFiles, chosen)
    if not (data or files.given):
        raise click.UsageError(
            "Missing argument 'DATA...', or --pixels with --joints and --camera."
        )
    if not files.given:
        refuse(OF_CAMERAS, "is about what cameras see, with pixels=, joints= and camera=")
    return files.among([read_rows(path) for path in data])


def together(
    verb: Callable[..., Any],
    robot: str,
    data: Sequence[Any],
    files: PixelFiles,
    to: Output,
    chosen: dict[str, Any],
) -> int:
    """What a verb says of data of any instruments, and of what cameras saw; the exit code."""
    from minimax_cal.fitting.pixels.beside import detected

    to.undrawn()
    seen = [detected(*files.paths())] if files.given else []
    found = to.work(verb, robot, [*data, *seen], **chosen)
    return to.finish(found, status=found.status, reason=found.reason)


def result_options(what: str, *, keep: str = "", figure: str = "") -> Decorator:
    """The options of a result.

    what: what -o writes.  keep: what its file is called in advice, where --details shows more than
    a first screen.  figure: what --figure draws, if anything.
    """
    rows, draws = "CSV" in what, bool(figure)
    ends = f"{'.csv or ' * rows}.json{', or the picture to a .png, .svg or .pdf' * draws},"
    drawn = click.option("--figure", type=PATH, help=f"Draw {figure} to this PNG, SVG or PDF.")
    told = (JSON, output(f"{what}, {ends}"), QUIET)
    more = (*[DETAILS] * bool(keep), *[drawn] * draws)
    return stacked(*more, *told, with_output(rows=rows, draws=draws, keep=keep))


def output(what: str) -> Decorator:
    """The option -o."""
    return click.option("-o", "--output", type=PATH, help=f"Write {what} to this file.")


def terminal() -> Console:
    """Stdout, as wide as the terminal, or 110 columns elsewhere."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDTH)


def show(*tables: Table, headline: str = "") -> None:
    """Print what tables come to on stdout, and the tables."""
    console = terminal()
    if headline:
        console.print(Text(visible(headline)), soft_wrap=not console.is_terminal)
        click.echo()
    for table in tables:
        table.show(console)


def writable(*paths: Path | None) -> None:
    """Raise an error, before any work, for an output that cannot be written."""
    for path in paths:
        if path:
            check_writable(path)


def drawable(path: Path | None) -> None:
    """Raise an error, before any work, for a picture that cannot be drawn."""
    if path:
        from minimax_cal.reporting.plots.figures import NEEDED, PICTURES

        check_writable(path, PICTURES)
        if find_spec("matplotlib") is None:
            raise OptionError(NEEDED)


def exit_code(status: Status, reason: str = "") -> int:
    """Of how the numbers ended, with a line of error where they did not work out.

    reason: why, of this result; the advice for all such results unless given.
    """
    if status is Status.CONVERGED:
        return 0
    return complain(f"{status}: {flagged(reason) or status.advice}")


def looked_up(as_json: bool, content: object, *tables: Table) -> int:
    """Print JSON, or tables; the exit code."""
    if as_json:
        click.echo(json_text(plain(content)), nl=False)
    else:
        show(*tables)
    return 0

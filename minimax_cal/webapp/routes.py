"""What the page asks for: sessions, their state, choices, files, and work."""

from __future__ import annotations

import asyncio
import gzip
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from functools import lru_cache, wraps
from hashlib import sha256
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import flush_to_disk, parse_json, replace_file_durably
from minimax_cal.reporting.html.chart_parts import PALETTE_COLOUR_NAMES
from minimax_cal.reporting.html.html_page import (
    import_report_packages,
    load_template,
    read_package_file,
)
from minimax_cal.webapp.job_runner import JobRunner
from minimax_cal.webapp.reader_pool import ReaderAnswer, ReaderPool
from minimax_cal.webapp.sessions import (
    MAX_UPLOADED_FILE_BYTES,
    MAX_UPLOADED_FILES,
    UPLOAD_FOLDER,
    Session,
    create_session_folder,
    list_sessions,
    open_session,
)
from minimax_cal.webapp.step_commands import (
    DIAGNOSIS_FILE,
    FIT_FILE,
    REPORT_FILE,
    SESSION_STEPS,
    CommandLine,
)

MAX_JSON_BODY_BYTES = 1 << 20  # bytes of choices
MAX_LENGTH_DIGITS = 19  # of a file's length: more than any disk holds
REPORT_SANDBOX_POLICY = (
    "sandbox allow-scripts allow-downloads allow-modals"  # a report has no part in the page
)
STATIC_MEDIA_TYPES = {"css": "text/css", "js": "text/javascript"}
RequestEndpoint = Callable[[Request], Awaitable[Response]]


def build_application(sessions_folder: Path) -> Starlette:
    """The page of all sessions in a folder."""

    @asynccontextmanager
    async def living(app: Starlette) -> AsyncIterator[None]:
        app.state.work, app.state.readers = JobRunner(), ReaderPool()
        app.state.changing = asyncio.Lock()  # choices are read, changed and written
        await app.state.readers.start_idle_reader()
        yield
        await asyncio.gather(app.state.work.cancel_all_jobs(), app.state.readers.kill_all_readers())

    app = Starlette(routes=PAGE_ROUTES, lifespan=living)
    app.state.root = sessions_folder
    return app


def build_error_response(error: CalibrationError, status: int = 400) -> Response:
    """What is wrong, in a line; nothing more is read of what comes with the request."""
    return JSONResponse({"error": str(error)}, status, {"Connection": "close"})


def answer_user_errors(endpoint: RequestEndpoint) -> RequestEndpoint:
    """An answer whose errors of the user are one line."""

    @wraps(endpoint)
    async def answered(request: Request) -> Response:
        try:
            return await endpoint(request)
        except CalibrationError as error:
            return build_error_response(error)
        except ClientDisconnect:  # or it was silent for too long
            return Response(status_code=400, headers={"Connection": "close"})

    return answered


def find_requested_session(request: Request) -> Session:
    """The session that an address names.  Raises OptionError."""
    return open_session(request.app.state.root, request.path_params["session"])


def get_job_runner(request: Request) -> JobRunner:
    """The processes."""
    found: JobRunner = request.app.state.work
    return found


async def ask_reader(
    request: Request, verb: str, session: Session, **arguments: Any
) -> ReaderAnswer:
    """What a process that reads files says of a session.  Raises CalibrationError."""
    pool: ReaderPool = request.app.state.readers
    return await pool.ask(verb, session, **arguments)


def build_reader_response(answer: ReaderAnswer) -> Response:
    """An answer as a reader wrote it."""
    return Response(answer.content, answer.status, media_type="application/json")


async def read_json_body(request: Request) -> dict[str, Any]:
    """The JSON object that a request brings.  Raises OptionError."""
    raw = bytearray()
    async for chunk in request.stream():
        raw += chunk
        if len(raw) > MAX_JSON_BODY_BYTES:
            raise OptionError("that is too much for choices")
    try:
        content = parse_json(bytes(raw))
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise OptionError("expected a JSON object")
    return content


# ---- pages -------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def load_page_template(template_name: str) -> Any:
    """A template of this package."""
    jinja, _ = import_report_packages()
    return load_template(jinja, template_name, "minimax_cal.webapp")


@answer_user_errors
async def serve_start_page(request: Request) -> Response:
    """All sessions."""
    found = [one.name for one in list_sessions(request.app.state.root)]
    return HTMLResponse(load_page_template("start.html.jinja").render(sessions=found))


@answer_user_errors
async def serve_session_page(request: Request) -> Response:
    """A session."""
    at = find_requested_session(request)
    made = load_page_template("page.html.jinja").render(
        name=at.name,
        folder=str(at.folder),
        palette=" ".join(PALETTE_COLOUR_NAMES),
        most=MAX_UPLOADED_FILE_BYTES,
    )
    return HTMLResponse(made)


@answer_user_errors
async def serve_static_file(request: Request) -> Response:
    """Styles and scripts, those of the report among them."""
    name = request.path_params["name"]
    if name == "plotly.js":
        headers = {"Content-Encoding": "gzip", "Cache-Control": "private, max-age=86400"}
        content = await run_in_threadpool(compress_plotly)
        return Response(content, media_type="text/javascript", headers=headers)
    own = {"serve.css", "serve.js", "start.js"}
    if name not in own | {"page.css", "drawing.js"}:
        return build_error_response(OptionError("no such file"), 404)
    text = read_package_file(
        name, "minimax_cal.webapp" if name in own else "minimax_cal.reporting.html"
    )
    return Response(text, media_type=STATIC_MEDIA_TYPES[name.rpartition(".")[2]])


@lru_cache(maxsize=1)
def compress_plotly() -> bytes:
    """plotly.js, compressed."""
    _, offline = import_report_packages()
    return gzip.compress(str(offline.get_plotlyjs()).encode(), 6, mtime=0)


# ---- state and choices -------------------------------------------------------------------------


@answer_user_errors
async def serve_session_state(request: Request) -> Response:
    """All that the page shows; of what it has seen already only the work that goes on."""
    at = find_requested_session(request)
    job = get_job_runner(request).jobs.get(at.name)
    marks = (at.list_file_versions(), job and (job.step, job.began, len(job.rungs)))
    now = sha256(repr(marks).encode()).hexdigest()[:16]
    working = {"stamp": now, "job": job.build_progress_json() if job else None}
    if request.query_params.get("seen") == now:
        return JSONResponse(working)
    step = {"step": job.step, "rungs": job.rungs} if job else None
    return build_reader_response(await ask_reader(request, "state", at, job=step, working=working))


@answer_user_errors
async def serve_chart(request: Request) -> Response:
    """A chart: traces and layout as plotly draws them."""
    at, name = find_requested_session(request), request.path_params["name"]
    path = at.folder / {"workspace": FIT_FILE, "ladder": DIAGNOSIS_FILE}.get(name, "")
    if not path.is_file():
        return build_error_response(OptionError("no such chart"), 404)
    return build_reader_response(await ask_reader(request, "view", at, name=name))


@answer_user_errors
async def create_session(request: Request) -> Response:
    """A new session."""
    title = (await read_json_body(request)).get("title", "")
    made = create_session_folder(request.app.state.root, title if isinstance(title, str) else "")
    return JSONResponse({"name": made.name})


@answer_user_errors
async def change_session_choices(request: Request) -> Response:
    """Choices."""
    at, changes = find_requested_session(request), await read_json_body(request)
    async with request.app.state.changing:
        await run_in_threadpool(at.update_choices, changes)
    return JSONResponse({})


# ---- files -------------------------------------------------------------------------------------


@answer_user_errors
async def receive_uploaded_file(request: Request) -> Response:
    """A file that is dropped; whole, or not at all."""
    at = find_requested_session(request)
    path = at.resolve_file(UPLOAD_FOLDER, request.query_params.get("name", ""))
    room = at.available_bytes(path.name)
    told = request.headers.get("content-length", "")
    if not told.isdecimal():
        return build_error_response(OptionError(f"{path.name}: comes without its length"), 411)
    too_large = OptionError(
        f"{path.name}: is larger than {room >> 20} MiB; that is no file of measurements"
    )
    if len(told) > MAX_LENGTH_DIGITS or int(told) > room:
        return build_error_response(too_large, 413)
    part_of_it: Path | None = None
    try:
        part_of_it = at.reserve_upload_file(path.name, int(told))
        with part_of_it.open("r+b") as stream:
            async for chunk in request.stream():  # no more than its length: the server sees to it
                await run_in_threadpool(stream.write, chunk)
            await run_in_threadpool(flush_to_disk, stream)
        await run_in_threadpool(replace_file_durably, part_of_it, path)
    except OSError as error:
        raise OptionError(f"{path.name}: cannot be kept ({error.strerror})") from error
    finally:
        if part_of_it:
            with suppress(OSError):
                part_of_it.unlink(missing_ok=True)
    return JSONResponse({"name": path.name, "bytes": int(told)})


@answer_user_errors
async def choose_uploaded_files(request: Request) -> Response:
    """Choose files that were dropped, in the place of those that they replace.

    All are read before any goes.
    """
    at, told = find_requested_session(request), await read_json_body(request)
    kind, names = told.get("kind"), told.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise OptionError("name the files, and what they are for")
    if len(names) > MAX_UPLOADED_FILES:
        raise OptionError(
            f"{len(names)} files are too many at once; choose at most {MAX_UPLOADED_FILES}"
        )
    contents = {}
    if kind == "measured":
        every = [*dict.fromkeys([*names, *at.choices.measured])]
        contents = (await ask_reader(request, "contents", at, names=every)).parse_content()
    elif kind == "targets":
        (await ask_reader(request, "targets", at, names=names)).parse_content()
    async with request.app.state.changing:
        await run_in_threadpool(at.choose_files_and_delete_replaced, str(kind), names, contents)
    return JSONResponse({})


@answer_user_errors
async def remove_uploaded_file(request: Request) -> Response:
    """Remove a file that was dropped; what is left of the measured ones is read again."""
    at, name = find_requested_session(request), request.query_params.get("name", "")
    async with request.app.state.changing:
        before = at.choices.measured
        left = (await run_in_threadpool(at.remove_uploaded_file, name)).measured
    if left and left != before and at.name not in get_job_runner(request).jobs:
        with suppress(CalibrationError):  # the file is gone all the same
            await start_step_job(request, at, "read")
    return JSONResponse({})


@answer_user_errors
async def serve_session_file(request: Request) -> Response:
    """A file of the session, to keep; the report also to look at, with no rights of this page."""
    at, name = find_requested_session(request), request.path_params["name"]
    path = at.resolve_file(name)
    if not path.is_file():
        return build_error_response(OptionError(f"there is no {path.name}"), 404)
    if name == REPORT_FILE and "look" in request.query_params:
        made = f"{REPORT_SANDBOX_POLICY}; frame-ancestors 'none'"
        headers = {"Content-Security-Policy": made}
        return FileResponse(path, media_type="text/html", headers=headers)
    return FileResponse(path, media_type="application/octet-stream", filename=path.name)


# ---- work --------------------------------------------------------------------------------------


@answer_user_errors
async def start_requested_step(request: Request) -> Response:
    """Begin a step."""
    at, name = find_requested_session(request), request.path_params["step"]
    if name not in SESSION_STEPS:
        raise OptionError("there is no such step")
    commands = await start_step_job(request, at, name)
    return JSONResponse({"lines": [command.format_shell_line() for command in commands]})


async def start_step_job(request: Request, session: Session, step_name: str) -> list[CommandLine]:
    """Begin a step; its command lines.  Raises CalibrationError where it cannot be done."""
    found = (await ask_reader(request, "commands", session, step=step_name)).parse_content()
    commands = [CommandLine(tuple(one["words"]), one["to"], one["judges"]) for one in found]
    get_job_runner(request).start_job(session, step_name, commands)
    return commands


@answer_user_errors
async def cancel_session_work(request: Request) -> Response:
    """End the work of a session."""
    at = find_requested_session(request)
    await get_job_runner(request).cancel_job(at.name)
    return JSONResponse({})


PAGE_ROUTES = [
    Route("/", serve_start_page),
    Route("/static/{name}", serve_static_file),
    Route("/sessions", create_session, methods=["POST"]),
    Route("/s/{session}", serve_session_page),
    Route("/s/{session}/state", serve_session_state),
    Route("/s/{session}/view/{name}", serve_chart),
    Route("/s/{session}/choices", change_session_choices, methods=["PATCH"]),
    Route("/s/{session}/given", receive_uploaded_file, methods=["PUT"]),
    Route("/s/{session}/given", choose_uploaded_files, methods=["POST"]),
    Route("/s/{session}/given", remove_uploaded_file, methods=["DELETE"]),
    Route("/s/{session}/file/{name:path}", serve_session_file),
    Route("/s/{session}/run/{step}", start_requested_step, methods=["POST"]),
    Route("/s/{session}/cancel", cancel_session_work, methods=["POST"]),
]

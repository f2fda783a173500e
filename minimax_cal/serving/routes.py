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

from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import json_of, put_on_disk, replace_on_disk
from minimax_cal.reporting.html.charts import PALETTE
from minimax_cal.reporting.html.page import needed, part, template
from minimax_cal.serving.reader_pool import Answer, ReaderPool
from minimax_cal.serving.sessions import (
    GIVEN,
    MOST_BYTES,
    MOST_FILES,
    Session,
    new_session,
    session,
    sessions,
)
from minimax_cal.serving.steps import DIAGNOSIS, FIT, REPORT, STEPS, Command
from minimax_cal.serving.work import Work

MOST_WORDS = 1 << 20  # bytes of choices
MOST_DIGITS = 19  # of a file's length: more than any disk holds
SEALED = "sandbox allow-scripts allow-downloads allow-modals"  # a report has no part in the page
KINDS = {"css": "text/css", "js": "text/javascript"}
Endpoint = Callable[[Request], Awaitable[Response]]


def application(root: Path) -> Starlette:
    """The page of all sessions in a folder."""

    @asynccontextmanager
    async def living(app: Starlette) -> AsyncIterator[None]:
        app.state.work, app.state.readers = Work(), ReaderPool()
        app.state.changing = asyncio.Lock()  # choices are read, changed and written
        await app.state.readers.fill()
        yield
        await asyncio.gather(app.state.work.close(), app.state.readers.close())

    app = Starlette(routes=ROUTES, lifespan=living)
    app.state.root = root
    return app


def said(error: CalibrationError, status: int = 400) -> Response:
    """What is wrong, in a line; nothing more is read of what comes with the request."""
    return JSONResponse({"error": str(error)}, status, {"Connection": "close"})


def asked(answer: Endpoint) -> Endpoint:
    """An answer whose errors of the user are one line."""

    @wraps(answer)
    async def answered(request: Request) -> Response:
        try:
            return await answer(request)
        except CalibrationError as error:
            return said(error)
        except ClientDisconnect:  # or it was silent for too long
            return Response(status_code=400, headers={"Connection": "close"})

    return answered


def session_of(request: Request) -> Session:
    """The session that an address names.  Raises OptionError."""
    return session(request.app.state.root, request.path_params["session"])


def work_of(request: Request) -> Work:
    """The processes."""
    found: Work = request.app.state.work
    return found


async def ask_reader(request: Request, verb: str, at: Session, **arguments: Any) -> Answer:
    """What a process that reads files says of a session.  Raises CalibrationError."""
    pool: ReaderPool = request.app.state.readers
    return await pool.ask(verb, at, **arguments)


def relayed(answer: Answer) -> Response:
    """An answer as a reader wrote it."""
    return Response(answer.content, answer.status, media_type="application/json")


async def words_of(request: Request) -> dict[str, Any]:
    """The JSON object that a request brings.  Raises OptionError."""
    raw = bytearray()
    async for chunk in request.stream():
        raw += chunk
        if len(raw) > MOST_WORDS:
            raise OptionError("that is too much for choices")
    try:
        content = json_of(bytes(raw))
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise OptionError("expected a JSON object")
    return content


# ---- pages -------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def page(name: str) -> Any:
    """A template of this package."""
    jinja, _ = needed()
    return template(jinja, name, "minimax_cal.serving")


@asked
async def start_page(request: Request) -> Response:
    """All sessions."""
    found = [one.name for one in sessions(request.app.state.root)]
    return HTMLResponse(page("start.html.jinja").render(sessions=found))


@asked
async def session_page(request: Request) -> Response:
    """A session."""
    at = session_of(request)
    made = page("page.html.jinja").render(
        name=at.name, folder=str(at.folder), palette=" ".join(PALETTE), most=MOST_BYTES
    )
    return HTMLResponse(made)


@asked
async def static(request: Request) -> Response:
    """Styles and scripts, those of the report among them."""
    name = request.path_params["name"]
    if name == "plotly.js":
        headers = {"Content-Encoding": "gzip", "Cache-Control": "private, max-age=86400"}
        content = await run_in_threadpool(packed_plotly)
        return Response(content, media_type="text/javascript", headers=headers)
    own = {"serve.css", "serve.js", "start.js"}
    if name not in own | {"page.css", "drawing.js"}:
        return said(OptionError("no such file"), 404)
    text = part(name, "minimax_cal.serving" if name in own else "minimax_cal.reporting.html")
    return Response(text, media_type=KINDS[name.rpartition(".")[2]])


@lru_cache(maxsize=1)
def packed_plotly() -> bytes:
    """plotly.js, compressed."""
    _, offline = needed()
    return gzip.compress(str(offline.get_plotlyjs()).encode(), 6, mtime=0)


# ---- state and choices -------------------------------------------------------------------------


@asked
async def state(request: Request) -> Response:
    """All that the page shows; of what it has seen already only the work that goes on."""
    at = session_of(request)
    job = work_of(request).jobs.get(at.name)
    marks = (at.stamp(), job and (job.step, job.began, len(job.rungs)))
    now = sha256(repr(marks).encode()).hexdigest()[:16]
    working = {"stamp": now, "job": job.state() if job else None}
    if request.query_params.get("seen") == now:
        return JSONResponse(working)
    step = {"step": job.step, "rungs": job.rungs} if job else None
    return relayed(await ask_reader(request, "state", at, job=step, working=working))


@asked
async def view(request: Request) -> Response:
    """A chart: traces and layout as plotly draws them."""
    at, name = session_of(request), request.path_params["name"]
    path = at.folder / {"workspace": FIT, "ladder": DIAGNOSIS}.get(name, "")
    if not path.is_file():
        return said(OptionError("no such chart"), 404)
    return relayed(await ask_reader(request, "view", at, name=name))


@asked
async def begin(request: Request) -> Response:
    """A new session."""
    title = (await words_of(request)).get("title", "")
    made = new_session(request.app.state.root, title if isinstance(title, str) else "")
    return JSONResponse({"name": made.name})


@asked
async def choose(request: Request) -> Response:
    """Choices."""
    at, changes = session_of(request), await words_of(request)
    async with request.app.state.changing:
        await run_in_threadpool(at.choose, changes)
    return JSONResponse({})


# ---- files -------------------------------------------------------------------------------------


@asked
async def put(request: Request) -> Response:
    """A file that is dropped; whole, or not at all."""
    at = session_of(request)
    path = at.file(GIVEN, request.query_params.get("name", ""))
    room = at.room(path.name)
    told = request.headers.get("content-length", "")
    if not told.isdecimal():
        return said(OptionError(f"{path.name}: comes without its length"), 411)
    too_large = OptionError(
        f"{path.name}: is larger than {room >> 20} MiB; that is no file of measurements"
    )
    if len(told) > MOST_DIGITS or int(told) > room:
        return said(too_large, 413)
    part_of_it: Path | None = None
    try:
        part_of_it = at.part(path.name, int(told))
        with part_of_it.open("r+b") as stream:
            async for chunk in request.stream():  # no more than its length: the server sees to it
                await run_in_threadpool(stream.write, chunk)
            await run_in_threadpool(put_on_disk, stream)
        await run_in_threadpool(replace_on_disk, part_of_it, path)
    except OSError as error:
        raise OptionError(f"{path.name}: cannot be kept ({error.strerror})") from error
    finally:
        if part_of_it:
            with suppress(OSError):
                part_of_it.unlink(missing_ok=True)
    return JSONResponse({"name": path.name, "bytes": int(told)})


@asked
async def take(request: Request) -> Response:
    """Choose files that were dropped, in the place of those that they replace.

    All are read before any goes.
    """
    at, told = session_of(request), await words_of(request)
    kind, names = told.get("kind"), told.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise OptionError("name the files, and what they are for")
    if len(names) > MOST_FILES:
        raise OptionError(f"{len(names)} files are too many at once; choose at most {MOST_FILES}")
    contents = {}
    if kind == "measured":
        every = [*dict.fromkeys([*names, *at.choices.measured])]
        contents = (await ask_reader(request, "contents", at, names=every)).value()
    elif kind == "targets":
        (await ask_reader(request, "targets", at, names=names)).value()
    async with request.app.state.changing:
        await run_in_threadpool(at.take, str(kind), names, contents)
    return JSONResponse({})


@asked
async def drop(request: Request) -> Response:
    """Remove a file that was dropped; what is left of the measured ones is read again."""
    at, name = session_of(request), request.query_params.get("name", "")
    async with request.app.state.changing:
        before = at.choices.measured
        left = (await run_in_threadpool(at.remove, name)).measured
    if left and left != before and at.name not in work_of(request).jobs:
        with suppress(CalibrationError):  # the file is gone all the same
            await start_step(request, at, "read")
    return JSONResponse({})


@asked
async def fetch(request: Request) -> Response:
    """A file of the session, to keep; the report also to look at, with no rights of this page."""
    at, name = session_of(request), request.path_params["name"]
    path = at.file(name)
    if not path.is_file():
        return said(OptionError(f"there is no {path.name}"), 404)
    if name == REPORT and "look" in request.query_params:
        made = f"{SEALED}; frame-ancestors 'none'"
        headers = {"Content-Security-Policy": made}
        return FileResponse(path, media_type="text/html", headers=headers)
    return FileResponse(path, media_type="application/octet-stream", filename=path.name)


# ---- work --------------------------------------------------------------------------------------


@asked
async def run(request: Request) -> Response:
    """Begin a step."""
    at, name = session_of(request), request.path_params["step"]
    if name not in STEPS:
        raise OptionError("there is no such step")
    commands = await start_step(request, at, name)
    return JSONResponse({"lines": [command.line() for command in commands]})


async def start_step(request: Request, at: Session, name: str) -> list[Command]:
    """Begin a step; its command lines.  Raises CalibrationError where it cannot be done."""
    found = (await ask_reader(request, "commands", at, step=name)).value()
    commands = [Command(tuple(one["words"]), one["to"], one["judges"]) for one in found]
    work_of(request).start(at, name, commands)
    return commands


@asked
async def cancel(request: Request) -> Response:
    """End the work of a session."""
    at = session_of(request)
    await work_of(request).cancel(at.name)
    return JSONResponse({})


ROUTES = [
    Route("/", start_page),
    Route("/static/{name}", static),
    Route("/sessions", begin, methods=["POST"]),
    Route("/s/{session}", session_page),
    Route("/s/{session}/state", state),
    Route("/s/{session}/view/{name}", view),
    Route("/s/{session}/choices", choose, methods=["PATCH"]),
    Route("/s/{session}/given", put, methods=["PUT"]),
    Route("/s/{session}/given", take, methods=["POST"]),
    Route("/s/{session}/given", drop, methods=["DELETE"]),
    Route("/s/{session}/file/{name:path}", fetch),
    Route("/s/{session}/run/{step}", run, methods=["POST"]),
    Route("/s/{session}/cancel", cancel, methods=["POST"]),
]

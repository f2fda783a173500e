"""A program of its own: reads files of sessions, so that the server of the page never waits.

Questions come on stdin, a line of JSON each: verb, folder of the session, further arguments.  An
answer is a line of JSON with `status` and `bytes`, and then so many bytes of JSON for the browser.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO, NamedTuple

from minimax_cal.compensation.target_file import read_target_file
from minimax_cal.core.errors import CalibrationError, CalibrationWarning
from minimax_cal.core.files import parse_json
from minimax_cal.webapp.job_runner import StepProgress
from minimax_cal.webapp.page_panels import build_page_state, read_diagnosis_summary
from minimax_cal.webapp.point_errors import build_workspace_view_data
from minimax_cal.webapp.sessions import UPLOAD_FOLDER, Session, file_version
from minimax_cal.webapp.step_commands import DIAGNOSIS_FILE, FIT_FILE, SESSION_STEPS


def read_state(
    session: Session, job: dict[str, Any] | None, working: dict[str, Any]
) -> dict[str, Any]:
    """All that the page shows.  job: of a `StepProgress`.  working: for the browser as it is."""
    return {**build_page_state(session, StepProgress(**job) if job else None), **working}


def read_chart(session: Session, name: str) -> dict[str, Any]:
    """A chart: traces and layout as plotly draws them."""
    if name == "workspace":
        return build_workspace_view_data(*file_version(session.folder / FIT_FILE))
    return read_diagnosis_summary(*file_version(session.folder / DIAGNOSIS_FILE)).chart


def read_file_content_kinds(session: Session, names: Sequence[str]) -> dict[str, list[str]]:
    """What each of some dropped files holds: joints, points, both or neither."""
    return {name: sorted(session.read_content_kinds(name)) for name in names}


def check_target_files(session: Session, names: Sequence[str]) -> dict[str, Any]:
    """Raise CalibrationError for files that are no joint targets."""
    for name in names:
        read_target_file(session.resolve_file(UPLOAD_FOLDER, name))
    return {}


def build_step_commands(session: Session, step: str) -> list[dict[str, Any]]:
    """The command lines of a step.  Raises CalibrationError where it cannot be done yet."""
    return [
        asdict(command) for command in SESSION_STEPS[step].build_commands(session, session.choices)
    ]


class HttpAnswer(NamedTuple):
    """Status of HTTP, and JSON for the browser."""

    status: int
    json_bytes: bytes


QUESTION_HANDLERS: dict[str, Callable[..., Any]] = {
    "state": read_state,
    "view": read_chart,
    "contents": read_file_content_kinds,
    "targets": check_target_files,
    "commands": build_step_commands,
}


def answer_question(question_line: bytes) -> HttpAnswer:
    """Status of HTTP, and the JSON of an answer or of what is wrong."""
    question = parse_json(question_line)
    verb, folder = question.pop("verb"), Path(question.pop("folder"))
    try:
        found, status = QUESTION_HANDLERS[verb](Session(folder), **question), 200
    except CalibrationError as error:
        found, status = {"error": str(error)}, 400
    except MemoryError:
        found, status = {"error": "there is not enough memory to read this session"}, 500
    except Exception:
        traceback.print_exc()
        found, status = {"error": "this session could not be read; the terminal says why"}, 500
    return HttpAnswer(status, json.dumps(found, ensure_ascii=False, allow_nan=False).encode())


def queue_stdin_questions_then_exit(queue: SimpleQueue[bytes]) -> None:
    """Take questions from stdin, until the server has ended: then this process does at once."""
    for line in sys.stdin.buffer:
        queue.put(line)
    os._exit(0)


def answer_questions_forever(answer_stream: BinaryIO) -> None:
    """Answer one question after another."""
    questions: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=queue_stdin_questions_then_exit, args=(questions,), daemon=True).start()
    while True:
        status, content = answer_question(questions.get())
        head = json.dumps({"status": status, "bytes": len(content)}).encode()
        answer_stream.write(head + b"\n" + content)
        answer_stream.flush()


if __name__ == "__main__":
    warnings.simplefilter("ignore", CalibrationWarning)
    own = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    try:
        answer_questions_forever(own)
    except (KeyboardInterrupt, BrokenPipeError):  # of the terminal that the server ends by, too
        os._exit(0)

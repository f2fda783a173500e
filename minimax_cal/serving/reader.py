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
from typing import Any, BinaryIO

from minimax_cal.correcting.target_file import read_targets
from minimax_cal.ground.errors import CalibrationError, CalibrationWarning
from minimax_cal.ground.files import json_of
from minimax_cal.serving.cell import view_of
from minimax_cal.serving.panels import diagnosis_words, state_of
from minimax_cal.serving.sessions import GIVEN, Session, mark
from minimax_cal.serving.steps import DIAGNOSIS, FIT, STEPS
from minimax_cal.serving.work import Progress


def read_state(at: Session, job: dict[str, Any] | None, working: dict[str, Any]) -> dict[str, Any]:
    """All that the page shows.  job: of a `Progress`.  working: for the browser as it is."""
    return {**state_of(at, Progress(**job) if job else None), **working}


def read_view(at: Session, name: str) -> dict[str, Any]:
    """A chart: traces and layout as plotly draws them."""
    if name == "workspace":
        return view_of(*mark(at.folder / FIT))
    return diagnosis_words(*mark(at.folder / DIAGNOSIS))[2]


def read_contents(at: Session, names: Sequence[str]) -> dict[str, list[str]]:
    """What each of some dropped files holds: joints, points, both or neither."""
    return {name: sorted(at.held(name)) for name in names}


def check_targets(at: Session, names: Sequence[str]) -> dict[str, Any]:
    """Raise CalibrationError for files that are no joint targets."""
    for name in names:
        read_targets(at.file(GIVEN, name))
    return {}


def read_commands(at: Session, step: str) -> list[dict[str, Any]]:
    """The command lines of a step.  Raises CalibrationError where it cannot be done yet."""
    return [asdict(command) for command in STEPS[step].commands(at, at.choices)]


VERBS: dict[str, Callable[..., Any]] = {
    "state": read_state,
    "view": read_view,
    "contents": read_contents,
    "targets": check_targets,
    "commands": read_commands,
}


def answer_question(line: bytes) -> tuple[int, bytes]:
    """Status of HTTP, and the JSON of an answer or of what is wrong."""
    question = json_of(line)
    verb, folder = question.pop("verb"), Path(question.pop("folder"))
    try:
        found, status = VERBS[verb](Session(folder), **question), 200
    except CalibrationError as error:
        found, status = {"error": str(error)}, 400
    except MemoryError:
        found, status = {"error": "there is not enough memory to read this session"}, 500
    except Exception:
        traceback.print_exc()
        found, status = {"error": "this session could not be read; the terminal says why"}, 500
    return status, json.dumps(found, ensure_ascii=False, allow_nan=False).encode()


def queue_questions(questions: SimpleQueue[bytes]) -> None:
    """Take questions from stdin, until the server has ended: then this process does at once."""
    for line in sys.stdin.buffer:
        questions.put(line)
    os._exit(0)


def answer_questions(answers: BinaryIO) -> None:
    """Answer one question after another."""
    questions: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=queue_questions, args=(questions,), daemon=True).start()
    while True:
        status, content = answer_question(questions.get())
        head = json.dumps({"status": status, "bytes": len(content)}).encode()
        answers.write(head + b"\n" + content)
        answers.flush()


if __name__ == "__main__":
    warnings.simplefilter("ignore", CalibrationWarning)
    own = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    try:
        answer_questions(own)
    except (KeyboardInterrupt, BrokenPipeError):  # of the terminal that the server ends by, too
        os._exit(0)

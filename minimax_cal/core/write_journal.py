"""What a command has written so far, to take it back where the command fails."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import NamedTuple

MAX_HIDDEN_STEM_LETTERS = 40  # letters of a name that stand in that of its temporary neighbour


class JournalEntry(NamedTuple):
    """A file that was written: its path, a hidden link to the file before it, if there was one."""

    path: Path
    backup_path: Path
    had_file: bool


WriteJournal = list[JournalEntry]  # since `undo_writes_on_error` began
WRITE_JOURNAL: ContextVar[WriteJournal | None] = ContextVar("JOURNAL", default=None)


@contextmanager
def undo_writes_on_error() -> Iterator[None]:
    """Take back all that `write_whole` wrote inside, where that ends by an error or a signal.

    Old files are as they were then.  Not by an OSError, as of a reader of stdout that has ended:
    results are whole and asked for.
    """
    journal: WriteJournal = []
    token = WRITE_JOURNAL.set(journal)
    try:
        yield
    except OSError:
        raise
    except BaseException:
        for path, old, existed in reversed(journal):
            with suppress(OSError):
                if not existed:
                    path.unlink(missing_ok=True)
                elif old.exists():
                    os.replace(old, path)
        raise
    finally:
        WRITE_JOURNAL.reset(token)
        try:
            remove_backup_files(journal)
        except BaseException:  # a signal that came in between
            remove_backup_files(journal)
            raise


def remove_backup_files(journal: WriteJournal) -> None:
    """Remove the hidden links to old files."""
    for _, old, _ in journal:
        with suppress(OSError):
            old.unlink(missing_ok=True)


def link_backup_in_journal(path: Path) -> None:
    """Keep the file at a path by another link, for `undo_writes_on_error` to put it back."""
    journal = WRITE_JOURNAL.get()
    if journal is None:
        return
    old, existed = unused_hidden_path_in_folder_of(path), path.exists()
    journal.append(JournalEntry(path, old, existed))
    if existed:
        try:
            os.link(path, old)
        except OSError:  # a file system without links
            shutil.copy2(path, old)


def unused_hidden_path_in_folder_of(path: Path) -> Path:
    """A name in the folder of a path that no other file has."""
    return path.with_name(f".{path.name[:MAX_HIDDEN_STEM_LETTERS]}.{os.urandom(4).hex()}")

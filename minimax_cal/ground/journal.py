"""What a command has written so far, to take it back where the command fails."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

SHORT = 40  # letters of a name that stand in that of its temporary neighbour

# Of each file that was written since `all_or_none` began: its path, a hidden link to the file
# before it, and whether there was one.
Journal = list[tuple[Path, Path, bool]]
JOURNAL: ContextVar[Journal | None] = ContextVar("JOURNAL", default=None)


@contextmanager
def all_or_none() -> Iterator[None]:
    """Take back all that `write_whole` wrote inside, where that ends by an error or a signal.

    Old files are as they were then.  Not by an OSError, as of a reader of stdout that has ended:
    results are whole and asked for.
    """
    journal: Journal = []
    token = JOURNAL.set(journal)
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
        JOURNAL.reset(token)
        try:
            forget_old(journal)
        except BaseException:  # a signal that came in between
            forget_old(journal)
            raise


def forget_old(journal: Journal) -> None:
    """Remove the hidden links to old files."""
    for _, old, _ in journal:
        with suppress(OSError):
            old.unlink(missing_ok=True)


def keep_old(path: Path) -> None:
    """Keep the file at a path by another link, for `all_or_none` to put it back."""
    journal = JOURNAL.get()
    if journal is None:
        return
    old, existed = hidden_name(path), path.exists()
    journal.append((path, old, existed))
    if existed:
        try:
            os.link(path, old)
        except OSError:  # a file system without links
            shutil.copy2(path, old)


def hidden_name(path: Path) -> Path:
    """A name in the folder of a path that no other file has."""
    return path.with_name(f".{path.name[:SHORT]}.{os.urandom(4).hex()}")

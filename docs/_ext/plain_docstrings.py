"""Docstrings of this project, which are plain prose, as reStructuredText.

A docstring is a sentence, then notes on arrays and arguments (``q: (m, n) joint values [rad].  y:
(m, 3) points [m].``), then more prose.  Notes become a list; fields of a dataclass become its
attributes, with type and default; an example (``>>>``) stays one; everything else keeps its words,
and no letter of them is taken for markup.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

import minimax_cal
import qp_backends

OURS = ("minimax_cal", "qp_backends")
CODE = re.compile(r"``(.+?)``|`(.+?)`")
MARKUP = re.compile(r"([\\*|`_])")
PLAIN = (str, int, float, bool, tuple)
PUBLIC = {  # where a class is defined: where the reference has it
    f"{thing.__module__}.{thing.__qualname__}": f"{package.__name__}.{name}"
    for package in (minimax_cal, qp_backends)
    for name in package.__all__
    if isinstance(thing := getattr(package, name), type)
}
MOST = 10  # fields that a constructor shows; what has more is made by the library, not by hand


@dataclasses.dataclass(frozen=True)
class Note:
    """A piece of a docstring: prose, or what it says of some names."""

    names: tuple[str, ...]
    text: str


def notes(paragraph: str, names: Sequence[str]) -> Iterator[Note]:
    """The paragraph cut where a sentence starts with `name:`, or with Returns or Raises."""
    joined = " ".join(paragraph.split())
    if not names:
        yield Note((), joined)
        return
    one = "|".join(re.escape(name) for name in names)
    cut = re.compile(rf"(?:^|(?<=[.)] ))(?:({one})((?:, (?:{one}))*): |(?=Returns |Raises ))")
    at, owners = 0, ()
    for found in cut.finditer(joined):
        if text := joined[at : found.start()].strip():
            yield Note(owners, text)
        listed = (found[1] or "") + (found[2] or "")
        at, owners = found.end(), tuple(filter(None, listed.split(", ")))
    yield Note(owners, joined[at:].strip())


def escaped(text: str) -> str:
    """Text in which no letter is markup."""
    return MARKUP.sub(r"\\\1", text)


def rst(text: str) -> str:
    """Prose as reStructuredText: `code` is code, and nothing else means anything."""
    out, at = [], 0
    for found in CODE.finditer(text):
        out.append(escaped(text[at : found.start()]))
        name = found[1] or found[2]
        role = ":py:obj:" if found[2] and re.fullmatch(r"[A-Za-z][\w.]*", name) else ""
        out.append(f"{role}`{name}`" if role else f"``{name}``")
        at = found.end()
    return "".join([*out, escaped(text[at:])])


def paragraphs(lines: Sequence[str]) -> list[str]:
    """Blocks between empty lines."""
    return [block for block in re.split(r"\n\s*\n", "\n".join(lines).strip()) if block.strip()]


def names_of(what: str, thing: Any) -> tuple[str, ...]:
    """What a docstring may have notes on: fields, or parameters."""
    if dataclasses.is_dataclass(thing):
        return tuple(field.name for field in dataclasses.fields(thing))
    if what in ("function", "method") and not inspect.isbuiltin(thing):
        return tuple(name for name in inspect.signature(thing).parameters if name != "self")
    return ()


def own_names(paragraph: str) -> tuple[str, ...]:
    """Words that a paragraph explains itself, each at the start of a line; one alone is prose."""
    found = re.findall(r"^ *([A-Za-z_]\w*(?:, \w+)*): ", paragraph, flags=re.MULTILINE)
    names = tuple(name for names in found for name in names.split(", "))
    return names if len(found) > 1 else ()


def listed(blocks: Sequence[str], names: Sequence[str]) -> list[str]:
    """Prose and a list of notes."""
    lines: list[str] = []
    before: tuple[str, ...] = ()
    for block in blocks:
        if block.lstrip().startswith(">>>"):
            lines += ["", *inspect.cleandoc(block).splitlines(), ""]
            before = ()
            continue
        for note in notes(block, (*names, *own_names(block))):
            if not (note.names and before):
                lines.append("")
            who = ", ".join(f"**{escaped(name)}**" for name in note.names)
            lines.append(f"* {who}: {rst(note.text)}" if who else rst(note.text))
            before = note.names
    return lines


def fields(blocks: Sequence[str], thing: Any) -> list[str]:
    """Prose, then every field as an attribute with what the notes say of it."""
    every = {field.name: field for field in dataclasses.fields(thing)}
    lines: list[str] = []
    said: list[Note] = []
    for block in blocks:
        for note in notes(block, tuple(every)):
            if note.names:
                said.append(note)
            else:
                lines += ["", rst(note.text)]
    told = {name for note in said for name in note.names}
    said += [Note((name,), "") for name in every if name not in told]
    order = list(every)
    for note in sorted(said, key=lambda note: order.index(note.names[0])):
        for name in note.names:  # what is said of several stands under the last of them
            lines += ["", f".. py:attribute:: {name}"]
            lines += [f"   :type: {linked(str(every[name].type), thing)}", *default(every[name])]
        lines += ["", f"   {rst(note.text)}"]
    return lines


def linked(annotation: str, thing: Any) -> str:
    """An annotation as written in the class, with the project's classes by their full names."""
    known = vars(sys.modules[thing.__module__])

    def full(found: re.Match[str]) -> str:
        there = known.get(found[0])
        if not isinstance(there, type) or not there.__module__.startswith(OURS):
            return found[0]
        place = f"{there.__module__}.{there.__qualname__}"
        return f"~{PUBLIC.get(place, place)}"

    return re.sub(r"[A-Za-z_]\w*", full, annotation)


def default(field: dataclasses.Field[Any]) -> list[str]:
    """The option that shows a default, where it is a plain value."""
    shown = isinstance(field.default, PLAIN) and field.default != ""
    return [f"   :value: {field.default!r}"] if shown else []


def rewrite(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """The docstring that autodoc is about to use, in place."""
    blocks = paragraphs(lines)
    if name in OURS:
        lines.clear()  # their pages begin with words of their own
    elif what == "class" and dataclasses.is_dataclass(thing):
        lines[:] = fields(blocks, thing)
    else:
        lines[:] = listed(blocks, names_of(what, thing))
    lines.append("")


def shorten(
    app: Sphinx,
    what: str,
    name: str,
    thing: Any,
    options: Any,
    signature: str | None,
    returns: str | None,
) -> tuple[str, str] | None:
    """A dataclass shows the names of its fields alone: their types stand below."""
    if what == "class" and dataclasses.is_dataclass(thing):
        names = [field.name for field in dataclasses.fields(thing)]
        return f"({', '.join(names)})" if len(names) <= MOST else "", ""
    if signature is None:  # of a module or a property
        return None
    return in_reference(signature), in_reference(returns or "")


def in_reference(signature: str) -> str:
    """A signature whose types link to where the reference has them."""
    return re.sub(r"[\w.]+", lambda found: PUBLIC.get(found[0], found[0]), signature)


def plain_alias(alias: TypeAliasForwardRef) -> str:
    """An alias by its name, also where it stands within other types."""
    return alias.name


def setup(app: Sphinx) -> dict[str, bool]:
    """Listen to autodoc."""
    TypeAliasForwardRef.__repr__ = plain_alias  # type: ignore[method-assign]
    app.connect("autodoc-process-docstring", rewrite)
    app.connect("autodoc-process-signature", shorten)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

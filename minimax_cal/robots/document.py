"""An XML file as a tree to change, and its bytes with nothing but the changes.

Every element remembers the bytes of its tags and what stood between them, comments and blanks
with it.  Written again, an element that did not change is its own bytes; a changed tag keeps its
order, quotes and blanks; a new element stands on a line of its own.  Includes are part of the tree;
one in which something changed is a file beside the written one, or written out where that has none.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.parsers import expat
from xml.sax.saxutils import escape

from minimax_cal.ground.errors import RobotError
from minimax_cal.ground.files import read_raw
from minimax_cal.robots.urdf_file import ATTRIBUTE, parse_xml

DEEPEST = 20  # includes within includes
NESTED = 100  # elements within elements
NESTED_TOO_DEEP = f"elements within elements, {NESTED} deep: no arm is so"
SPACED = re.compile(rb"(\s+)" + ATTRIBUTE.pattern)  # an attribute and the blanks before it


@dataclass(eq=False)
class Included:
    """What an <include> brought: its own bytes, what stands before the first element, and these.

    file: its name.  before, after: what its file has around what stands in its root.
    """

    tag: bytes
    tail: bytes
    head: bytes
    children: tuple[ET.Element, ...] = ()
    file: str = ""
    before: bytes = b""
    after: bytes = b""


@dataclass(eq=False)
class Writing:
    """How a document is written.

    whole: with all that it includes, changed or not.  name: of the file, without its ending, whose
    changed includes are files beside it; empty where they are written out.  beside: these, by the
    ending that takes the place of the file's own.
    """

    whole: bool = False
    name: str = ""
    beside: dict[str, bytes] = field(default_factory=dict)


@dataclass(eq=False)
class Piece:
    """Bytes of an element: its start tag, what follows that, its end tag, and what follows it.

    attributes, children: as they were.  end is empty where the element has no content.
    """

    start: bytes
    text: bytes
    end: bytes
    tail: bytes
    attributes: dict[str, str]
    children: tuple[ET.Element, ...] = ()
    included: Included | None = None

    @staticmethod
    def of_tag(included: Included) -> Piece:
        """Of an <include> itself."""
        return Piece(included.tag, b"", b"", b"", {"file": included.file})

    @staticmethod
    def new(element: ET.Element) -> Piece:
        """Of an element that no file has."""
        start = b"<" + element.tag.encode() + attributes_text(element.items()) + b"/>"
        return Piece(start, b"", b"", b"", dict(element.attrib))


@dataclass(eq=False)
class Document:
    """root: the tree.  pieces: of each element that the files have.  before, after: the root."""

    root: ET.Element
    pieces: dict[ET.Element, Piece] = field(default_factory=dict)
    before: bytes = b""
    after: bytes = b""

    def copy(self) -> Document:
        """Another one, to be changed by itself."""
        return deepcopy(self)

    def raw(self, how: Writing | None = None) -> bytes:
        """The file."""
        return self.before + self.element(self.root, b"", how or Writing()) + self.after

    def element(self, element: ET.Element, indent: bytes, how: Writing) -> bytes:
        """The bytes of an element.  indent: line break and blanks before it."""
        piece = self.pieces.get(element) or Piece.new(element)
        start, end = tag_with(piece, element.attrib), piece.end
        if not len(element):
            return start + piece.text + end
        if not end:
            start, end = re.sub(rb"\s*/>\Z", b">", start), b"</" + element.tag.encode() + b">"
        if not piece.children:
            inside = self.inside(element, indent and indent + b"  ", how)
            return start + before_blank(piece.text, inside, indent) + end
        inside = self.inside(element, blank(piece.text), how)
        last = self.pieces[piece.children[-1]]
        closing = blank(last.included.tail if last.included else last.tail)
        return start + piece.text + before_blank(inside, b"", closing) + end

    def inside(self, parent: ET.Element, indent: bytes, how: Writing) -> bytes:
        """The bytes of what an element holds."""
        out, children, at = b"", list(parent), 0
        own = self.pieces[parent].children if parent in self.pieces else ()
        while at < len(children):
            child = children[at]
            piece = self.pieces.get(child)
            if piece is None or child not in own:
                out = before_blank(out, indent + self.element(child, indent, how))
            elif piece.included is None:
                out += self.element(child, indent, how) + piece.tail
            else:
                group = self.group(children, at, piece.included)
                out += self.include(piece.included, group, indent, how)
                at += len(group) - 1
            at += 1
        return out

    def group(self, children: list[ET.Element], first: int, included: Included) -> list[ET.Element]:
        """The children that one include brought, and new ones among them."""
        last = max(children.index(child) for child in included.children if child in children)
        return children[first : last + 1]

    def include(
        self, included: Included, children: list[ET.Element], indent: bytes, how: Writing
    ) -> bytes:
        """An include as it was; where what it brought changed, that, or its new file's name."""
        same = tuple(children) == included.children and not any(map(self.changed, children))
        if same and not how.whole:
            return included.tag + included.tail
        out = included.head if how.name else included.head.lstrip()
        for child in children:
            text = self.element(child, indent, how)
            if child in included.children:
                out += text + self.pieces[child].tail
            else:
                out = before_blank(out, indent + text)
        if not how.name:
            return out.rstrip() + included.tail
        ending = f".{Path(included.file).stem}.xml"
        if ending in how.beside:
            ending = f".{len(how.beside)}{ending}"
        how.beside[ending] = included.before + out + included.after
        attributes = {"file": f"{how.name}{ending}"}
        return tag_with(Piece.of_tag(included), attributes) + included.tail

    def changed(self, element: ET.Element) -> bool:
        """Whether anything in an element is other than it was."""
        piece = self.pieces.get(element)
        return (
            piece is None
            or piece.attributes != element.attrib
            or piece.children != tuple(element)
            or any(map(self.changed, element))
        )


def blank(text: bytes) -> bytes:
    """The line break and blanks at the end of a text, before what follows."""
    found = re.search(rb"\r?\n[ \t]*\Z", text)
    return found.group() if found else b""


def before_blank(out: bytes, new: bytes, end: bytes | None = None) -> bytes:
    """New bytes after others, before the blanks at their end.  end: in the place of those."""
    here = blank(out)
    return out[: len(out) - len(here)] + new + (here if end is None else end)


def attributes_text(items: Iterable[tuple[str, str]]) -> bytes:
    """Attributes as they stand in a tag."""
    return "".join(f' {name}="{quoted(value)}"' for name, value in items).encode()


def quoted(value: str) -> str:
    """A value between either kind of quotes."""
    return escape(value, {'"': "&quot;", "'": "&apos;", "\n": "&#10;", "\t": "&#9;"})


def tag_with(piece: Piece, attributes: dict[str, str]) -> bytes:
    """A start tag with other attributes, changed where it must be."""
    if attributes == piece.attributes:
        return piece.start
    told = piece.attributes

    def replaced(found: re.Match[bytes]) -> bytes:
        name, mark = found[2].decode(), found[3][:1]
        if name not in attributes:
            return b""
        if attributes[name] == told.get(name):
            return found[0]
        return found[0][: -len(found[3])] + mark + quoted(attributes[name]).encode() + mark

    start = SPACED.sub(replaced, piece.start)
    new = attributes_text((k, v) for k, v in attributes.items() if k not in told)
    end = re.search(rb"\s*/?>\Z", start)
    at = end.start() if end else len(start)
    return start[:at] + new + start[at:]


def read_document(path: Path) -> Document:
    """An XML file with all that it includes.  Raises RobotError."""
    try:
        return read_part(path, path.parent, 0)
    except RecursionError as error:
        raise RobotError(f"{path}: {NESTED_TOO_DEEP}") from error


def read_part(path: Path, folder: Path, depth: int) -> Document:
    """A file, or an included one.  folder: of the first file."""
    if depth > DEEPEST:
        raise RobotError(f"{path}: includes itself")
    raw = read_raw(path, kind=RobotError)
    parse_xml(raw, str(path))  # refuses document types, and what is not XML
    nodes = parsed(raw, path)
    document = Document(ET.Element(nodes.tag), {}, raw[: nodes.start], raw[nodes.stop :])
    fill(document, document.root, nodes, raw, path, folder, depth)
    return document


@dataclass(eq=False)
class Node:
    """An element of a file: start of its tag, end of that, start of its end tag, and stop."""

    tag: str
    attributes: dict[str, str]
    start: int
    opened: int = 0
    closing: int = 0
    stop: int = 0
    children: list[Node] = field(default_factory=list)


def parsed(raw: bytes, path: Path) -> Node:
    """The elements of a file with their bytes."""
    parser, stack, roots = expat.ParserCreate(), list[Node](), list[Node]()

    def start(tag: str, attributes: dict[str, str]) -> None:
        new = Node(tag, attributes, parser.CurrentByteIndex)
        new.opened = tag_end(raw, new.start)
        (stack[-1].children if stack else roots).append(new)
        stack.append(new)

    def end(tag: str) -> None:
        node = stack.pop()
        if raw[node.opened - 2 : node.opened] == b"/>":
            node.closing = node.stop = node.opened
        else:
            node.closing = parser.CurrentByteIndex
            node.stop = tag_end(raw, node.closing)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(raw, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # not of the declared encoding
        raise RobotError(f"{path}: is not XML ({error})") from error
    return roots[0]


def tag_end(raw: bytes, start: int) -> int:
    """The byte after the tag that starts here."""
    quote = b""
    for i in range(start, len(raw)):
        mark = raw[i : i + 1]
        if quote:
            quote = b"" if mark == quote else quote
        elif mark in (b'"', b"'"):
            quote = mark
        elif mark == b">":
            return i + 1
    return len(raw)


def fill(
    document: Document,
    element: ET.Element,
    node: Node,
    raw: bytes,
    path: Path,
    folder: Path,
    depth: int,
) -> None:
    """Give an element its attributes, its bytes and what is in it."""
    element.attrib.update(node.attributes)
    piece = Piece(raw[node.start : node.opened], b"", raw[node.closing : node.stop], b"",
                  dict(node.attributes))  # fmt: skip
    document.pieces[element] = piece
    at, last, found = node.opened, [piece], list[ET.Element]()

    def between(end: int) -> None:
        """What stands before an element belongs to the one before it, or to the parent's tag."""
        text = raw[at:end]
        one = last[0]
        if one is piece:
            piece.text += text
        elif one.included is not None:
            one.included.tail += text
        else:
            one.tail += text

    for child in node.children:
        if child.tag != "include":
            between(child.start)
            new = ET.SubElement(element, child.tag)
            fill(document, new, child, raw, path, folder, depth)
            last, at = [document.pieces[new]], child.stop
            found.append(new)
            continue
        part = included(path, folder, child.attributes.get("file", ""), depth)
        brought = list(part.root)
        if not brought:
            continue  # its bytes stay among the text
        between(child.start)
        around, name = part.pieces[part.root], child.attributes.get("file", "")
        record = Included(raw[child.start : child.stop], b"", around.text, tuple(brought), name,
                          part.before + around.start, around.end + part.after)  # fmt: skip
        document.pieces |= {k: v for k, v in part.pieces.items() if k is not part.root}
        for one in brought:
            element.append(one)
            document.pieces[one].included = record
        last, at = [document.pieces[brought[-1]]], child.stop
        found += brought
    between(node.closing)
    piece.children = tuple(found)


def included(path: Path, folder: Path, name: str, depth: int) -> Document:
    """The file that an <include> names, beside the first file or beside its own."""
    found = next((p / name for p in (folder, path.parent) if (p / name).is_file()), None)
    if found is None:
        raise RobotError(f"{path}: includes {name!r}, which is not there")
    return read_part(found, folder, depth + 1)

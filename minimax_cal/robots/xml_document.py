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

from minimax_cal.core.errors import RobotError
from minimax_cal.core.files import read_bytes
from minimax_cal.robots.urdf_file import XML_ATTRIBUTE_PATTERN, parse_xml_without_entities

MAX_INCLUDE_DEPTH = 20  # includes within includes
MAX_ELEMENT_DEPTH = 100  # elements within elements
TOO_DEEP_MESSAGE = f"elements within elements, {MAX_ELEMENT_DEPTH} deep: no arm is so"
SPACED_ATTRIBUTE_PATTERN = re.compile(
    rb"(\s+)" + XML_ATTRIBUTE_PATTERN.pattern
)  # an attribute and the blanks before it


@dataclass(eq=False)
class XmlInclude:
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
class XmlWriteOptions:
    """How a document is written.

    whole: with all that it includes, changed or not.  name: of the file, without its ending, whose
    changed includes are files beside it; empty where they are written out.  beside: these, by the
    ending that takes the place of the file's own.
    """

    whole: bool = False
    name: str = ""
    beside: dict[str, bytes] = field(default_factory=dict)


@dataclass(eq=False)
class ElementSource:
    """Bytes of an element: its start tag, what follows that, its end tag, and what follows it.

    attributes, children: as they were.  end is empty where the element has no content.
    """

    start: bytes
    text: bytes
    end: bytes
    tail: bytes
    attributes: dict[str, str]
    children: tuple[ET.Element, ...] = ()
    included: XmlInclude | None = None

    @staticmethod
    def from_include(include: XmlInclude) -> ElementSource:
        """Of an <include> itself."""
        return ElementSource(include.tag, b"", b"", b"", {"file": include.file})

    @staticmethod
    def for_new_element(element: ET.Element) -> ElementSource:
        """Of an element that no file has."""
        start = b"<" + element.tag.encode() + format_attributes(element.items()) + b"/>"
        return ElementSource(start, b"", b"", b"", dict(element.attrib))


@dataclass(eq=False)
class XmlDocument:
    """root: the tree.  pieces: of each element that the files have.  before, after: the root."""

    root: ET.Element
    pieces: dict[ET.Element, ElementSource] = field(default_factory=dict)
    before: bytes = b""
    after: bytes = b""

    def copy(self) -> XmlDocument:
        """Another one, to be changed by itself."""
        return deepcopy(self)

    def to_bytes(self, options: XmlWriteOptions | None = None) -> bytes:
        """The file."""
        return (
            self.before
            + self.element_to_bytes(self.root, b"", options or XmlWriteOptions())
            + self.after
        )

    def element_to_bytes(
        self, element: ET.Element, indent: bytes, options: XmlWriteOptions
    ) -> bytes:
        """The bytes of an element.  indent: line break and blanks before it."""
        piece = self.pieces.get(element) or ElementSource.for_new_element(element)
        start, end = start_tag_with_attributes(piece, element.attrib), piece.end
        if not len(element):
            return start + piece.text + end
        if not end:
            start, end = re.sub(rb"\s*/>\Z", b">", start), b"</" + element.tag.encode() + b">"
        if not piece.children:
            inside = self.content_to_bytes(element, indent and indent + b"  ", options)
            return start + insert_before_trailing_blanks(piece.text, inside, indent) + end
        inside = self.content_to_bytes(element, trailing_line_break_and_blanks(piece.text), options)
        last = self.pieces[piece.children[-1]]
        closing = trailing_line_break_and_blanks(last.included.tail if last.included else last.tail)
        return start + piece.text + insert_before_trailing_blanks(inside, b"", closing) + end

    def content_to_bytes(
        self, parent: ET.Element, indent: bytes, options: XmlWriteOptions
    ) -> bytes:
        """The bytes of what an element holds."""
        out, children, at = b"", list(parent), 0
        own = self.pieces[parent].children if parent in self.pieces else ()
        while at < len(children):
            child = children[at]
            piece = self.pieces.get(child)
            if piece is None or child not in own:
                out = insert_before_trailing_blanks(
                    out, indent + self.element_to_bytes(child, indent, options)
                )
            elif piece.included is None:
                out += self.element_to_bytes(child, indent, options) + piece.tail
            else:
                group = self.children_of_include(children, at, piece.included)
                out += self.include_to_bytes(piece.included, group, indent, options)
                at += len(group) - 1
            at += 1
        return out

    def children_of_include(
        self, children: list[ET.Element], first_index: int, include: XmlInclude
    ) -> list[ET.Element]:
        """The children that one include brought, and new ones among them."""
        last = max(children.index(child) for child in include.children if child in children)
        return children[first_index : last + 1]

    def include_to_bytes(
        self,
        xml_include: XmlInclude,
        children: list[ET.Element],
        indent: bytes,
        options: XmlWriteOptions,
    ) -> bytes:
        """An include as it was; where what it brought changed, that, or its new file's name."""
        same = tuple(children) == xml_include.children and not any(map(self.has_changed, children))
        if same and not options.whole:
            return xml_include.tag + xml_include.tail
        out = xml_include.head if options.name else xml_include.head.lstrip()
        for child in children:
            text = self.element_to_bytes(child, indent, options)
            if child in xml_include.children:
                out += text + self.pieces[child].tail
            else:
                out = insert_before_trailing_blanks(out, indent + text)
        if not options.name:
            return out.rstrip() + xml_include.tail
        ending = f".{Path(xml_include.file).stem}.xml"
        if ending in options.beside:
            ending = f".{len(options.beside)}{ending}"
        options.beside[ending] = xml_include.before + out + xml_include.after
        attributes = {"file": f"{options.name}{ending}"}
        return (
            start_tag_with_attributes(ElementSource.from_include(xml_include), attributes)
            + xml_include.tail
        )

    def has_changed(self, element: ET.Element) -> bool:
        """Whether anything in an element is other than it was."""
        piece = self.pieces.get(element)
        return (
            piece is None
            or piece.attributes != element.attrib
            or piece.children != tuple(element)
            or any(map(self.has_changed, element))
        )


def trailing_line_break_and_blanks(text: bytes) -> bytes:
    """The line break and blanks at the end of a text, before what follows."""
    found = re.search(rb"\r?\n[ \t]*\Z", text)
    return found.group() if found else b""


def insert_before_trailing_blanks(
    text: bytes, inserted: bytes, new_blanks: bytes | None = None
) -> bytes:
    """New bytes after others, before the blanks at their end.  new_blanks: in the place of
    those.
    """
    here = trailing_line_break_and_blanks(text)
    return text[: len(text) - len(here)] + inserted + (here if new_blanks is None else new_blanks)


def format_attributes(items: Iterable[tuple[str, str]]) -> bytes:
    """Attributes as they stand in a tag."""
    return "".join(f' {name}="{escape_attribute_value(value)}"' for name, value in items).encode()


def escape_attribute_value(value: str) -> str:
    """A value between either kind of quotes."""
    return escape(value, {'"': "&quot;", "'": "&apos;", "\n": "&#10;", "\t": "&#9;"})


def start_tag_with_attributes(element_source: ElementSource, attributes: dict[str, str]) -> bytes:
    """A start tag with other attributes, changed where it must be."""
    if attributes == element_source.attributes:
        return element_source.start
    told = element_source.attributes

    def replaced(found: re.Match[bytes]) -> bytes:
        name, mark = found[2].decode(), found[3][:1]
        if name not in attributes:
            return b""
        if attributes[name] == told.get(name):
            return found[0]
        return (
            found[0][: -len(found[3])]
            + mark
            + escape_attribute_value(attributes[name]).encode()
            + mark
        )

    start = SPACED_ATTRIBUTE_PATTERN.sub(replaced, element_source.start)
    new = format_attributes((k, v) for k, v in attributes.items() if k not in told)
    end = re.search(rb"\s*/?>\Z", start)
    at = end.start() if end else len(start)
    return start[:at] + new + start[at:]


def read_xml_with_includes(path: Path) -> XmlDocument:
    """An XML file with all that it includes.  Raises RobotError."""
    try:
        return read_xml_part(path, path.parent, 0)
    except RecursionError as error:
        raise RobotError(f"{path}: {TOO_DEEP_MESSAGE}") from error


def read_xml_part(path: Path, base_folder: Path, include_depth: int) -> XmlDocument:
    """A file, or an included one.  base_folder: of the first file."""
    if include_depth > MAX_INCLUDE_DEPTH:
        raise RobotError(f"{path}: includes itself")
    raw = read_bytes(path, error_type=RobotError)
    parse_xml_without_entities(raw, str(path))  # refuses document types, and what is not XML
    nodes = parse_element_spans(raw, path)
    document = XmlDocument(ET.Element(nodes.tag), {}, raw[: nodes.start], raw[nodes.stop :])
    fill_element_from_span(document, document.root, nodes, raw, path, base_folder, include_depth)
    return document


@dataclass(eq=False)
class XmlSpan:
    """An element of a file: start of its tag, end of that, start of its end tag, and stop."""

    tag: str
    attributes: dict[str, str]
    start: int
    opened: int = 0
    closing: int = 0
    stop: int = 0
    children: list[XmlSpan] = field(default_factory=list)


def parse_element_spans(raw: bytes, path: Path) -> XmlSpan:
    """The elements of a file with their bytes."""
    parser, stack, roots = expat.ParserCreate(), list[XmlSpan](), list[XmlSpan]()

    def start(tag: str, attributes: dict[str, str]) -> None:
        new = XmlSpan(tag, attributes, parser.CurrentByteIndex)
        new.opened = find_tag_end(raw, new.start)
        (stack[-1].children if stack else roots).append(new)
        stack.append(new)

    def end(tag: str) -> None:
        node = stack.pop()
        if raw[node.opened - 2 : node.opened] == b"/>":
            node.closing = node.stop = node.opened
        else:
            node.closing = parser.CurrentByteIndex
            node.stop = find_tag_end(raw, node.closing)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(raw, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # not of the declared encoding
        raise RobotError(f"{path}: is not XML ({error})") from error
    return roots[0]


def find_tag_end(raw: bytes, start: int) -> int:
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


def fill_element_from_span(
    document: XmlDocument,
    element: ET.Element,
    span: XmlSpan,
    raw: bytes,
    path: Path,
    base_folder: Path,
    include_depth: int,
) -> None:
    """Give an element its attributes, its bytes and what is in it."""
    element.attrib.update(span.attributes)
    piece = ElementSource(raw[span.start : span.opened], b"", raw[span.closing : span.stop], b"",
                  dict(span.attributes))  # fmt: skip
    document.pieces[element] = piece
    at, last, found = span.opened, [piece], list[ET.Element]()

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

    for child in span.children:
        if child.tag != "include":
            between(child.start)
            new = ET.SubElement(element, child.tag)
            fill_element_from_span(document, new, child, raw, path, base_folder, include_depth)
            last, at = [document.pieces[new]], child.stop
            found.append(new)
            continue
        part = read_included_file(
            path, base_folder, child.attributes.get("file", ""), include_depth
        )
        brought = list(part.root)
        if not brought:
            continue  # its bytes stay among the text
        between(child.start)
        around, name = part.pieces[part.root], child.attributes.get("file", "")
        record = XmlInclude(raw[child.start : child.stop], b"", around.text, tuple(brought), name,
                          part.before + around.start, around.end + part.after)  # fmt: skip
        document.pieces |= {k: v for k, v in part.pieces.items() if k is not part.root}
        for one in brought:
            element.append(one)
            document.pieces[one].included = record
        last, at = [document.pieces[brought[-1]]], child.stop
        found += brought
    between(span.closing)
    piece.children = tuple(found)


def read_included_file(
    path: Path, base_folder: Path, file_name: str, include_depth: int
) -> XmlDocument:
    """The file that an <include> names, beside the first file or beside its own."""
    found = next(
        (p / file_name for p in (base_folder, path.parent) if (p / file_name).is_file()), None
    )
    if found is None:
        raise RobotError(f"{path}: includes {file_name!r}, which is not there")
    return read_xml_part(found, base_folder, include_depth + 1)

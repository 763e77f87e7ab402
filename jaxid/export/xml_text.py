"""Text of XML: elements that are written, and changes of attributes in a file, all else left as it is."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

import numpy as np


@dataclass
class Element:
    """An element of the text.

    Args:
        tag: Its name.
        attributes: Its attributes.
        start, end: Bytes from the first of its start tag to the one behind it.
        children: Elements in it.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    end: int
    children: list[Element] = field(default_factory=list)

    def find(self, tag: str) -> Element | None:
        """Return the first child of a name; None if there is none."""
        return next((child for child in self.children if child.tag == tag), None)

    def walk(self) -> Iterator[Element]:
        """Return all elements in it, itself first."""
        yield self
        for child in self.children:
            yield from child.walk()


class XmlText:
    """An XML file whose start tags can be changed.

    Args:
        content: Bytes of the file.

    Raises:
        expat.ExpatError: If it is not XML.
    """

    def __init__(self, content: bytes) -> None:
        self.content = content
        self._edits: dict[tuple[int, int], bytes] = {}
        # Insertions behind a start tag, and end tags of elements that had none, by the end of the start tag.
        self._inside: dict[int, list[bytes]] = {}
        self._closing: dict[int, bytes] = {}
        self._before: dict[int, list[bytes]] = {}
        self._behind: dict[int, list[bytes]] = {}
        # An element around the first one, so that there is always a last one open.
        whole = Element("", {}, 0, 0)
        stack = [whole]
        parser = expat.ParserCreate()

        def start(tag: str, attributes: dict[str, str]) -> None:
            at = parser.CurrentByteIndex
            element = Element(tag, attributes, at, _end_of_tag(content, at))
            stack[-1].children.append(element)
            stack.append(element)

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda tag: stack.pop()
        parser.Parse(content, True)
        self.root = whole.children[0]

    def set(self, element: Element, values: Mapping[str, str | None]) -> None:
        """Set attributes of an element; None takes one away."""
        place = (element.start, element.end)
        text = self._edits.get(place, self.content[element.start : element.end]).decode()
        for name, value in values.items():
            pattern = re.compile(rf"\s+{name}\s*=\s*(\"[^\"]*\"|'[^']*')")
            shown = "" if value is None else f' {name}="{value}"'
            if pattern.search(text):
                text = pattern.sub(shown.replace("\\", r"\\"), text, count=1)
            elif value is not None:
                head, close = re.match(r"(?s)(.*?)(\s*/?>)$", text).groups()  # pyright: ignore[reportOptionalMemberAccess]  # a tag
                text = head + shown + close
        self._edits[place] = text.encode()

    def insert_into(self, element: Element, text: str) -> None:
        """Insert text as the first child of an element, behind other insertions, indented as its others.

        An element that is written as one tag gets an end tag.
        """
        indent = self._indent(element)
        if element.end not in self._inside:
            self._inside[element.end] = []
            place = (element.start, element.end)
            tag = self._edits.get(place, self.content[element.start : element.end])
            if tag.endswith(b"/>"):
                self._edits[place] = tag[:-2].rstrip() + b">"
                self._closing[element.end] = b"\n" + indent + f"</{element.tag}>".encode()
        self._inside[element.end].append(b"\n" + indent + b"  " + text.encode())

    def attribute(self, element: Element, name: str) -> str | None:
        """Return an attribute of an element as it will be written; None if it has none."""
        text = self._edits.get((element.start, element.end))
        if text is None:
            return element.attributes.get(name)
        found = re.search(rf"\s{name}\s*=\s*[\"']([^\"']*)", text.decode())
        return found and found[1]

    def insert_before(self, element: Element, text: str) -> None:
        """Insert text before an element, on a line of its own."""
        self._before.setdefault(element.start, []).append(text.encode() + b"\n" + self._indent(element))

    def _indent(self, element: Element) -> bytes:
        line = self.content.rfind(b"\n", 0, element.start) + 1
        indent = self.content[line : element.start]
        return indent if not indent.strip() else b""

    def insert_behind(self, element: Element, text: str) -> None:
        """Insert text behind an element without children, on a line of its own."""
        indent, end = self._indent(element), element.end
        if not self.content[element.start : end].endswith(b"/>"):
            end = self.content.index(b">", self.content.index(b"</", end)) + 1
        self._behind.setdefault(end, []).append(b"\n" + indent + text.encode())

    def text(self) -> bytes:
        """Return the file with all changes."""
        edits = dict(self._edits)
        for end, texts in self._inside.items():
            edits[(end, end)] = b"".join(texts) + self._closing.get(end, b"")
        for start, texts in self._before.items():
            edits[(start, start)] = b"".join(texts)
        for end, texts in self._behind.items():
            edits[(end, end)] = b"".join(texts) + edits.get((end, end), b"")
        out = self.content
        for (start, end), new in sorted(edits.items(), reverse=True):
            out = out[:start] + new + out[end:]
        return out


def numbers(values: Any) -> str:
    """Return numbers as XML holds them, to the last digit."""
    return " ".join(repr(float(v) + 0.0) for v in np.ravel(values))


def listed(values: Mapping[str, str]) -> str:
    """Return attributes of an XML element."""
    return " ".join(f'{name}="{escaped(value)}"' for name, value in values.items())


def escaped(text: str) -> str:
    """Return a text as an attribute of XML holds it."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


def _end_of_tag(content: bytes, at: int) -> int:
    """Return the byte behind a start tag; a bracket between quotes is none of its own."""
    quote = 0
    for k in range(at, len(content)):
        byte = content[k]
        if quote:
            quote = 0 if byte == quote else quote
        elif byte in b"\"'":
            quote = byte
        elif byte == ord(">"):
            return k + 1
    return len(content)

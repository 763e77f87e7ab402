"""Variables of MATLAB files: matrices of real numbers of version 5 to 7.2.

SciPy's parser ends the process on some damaged files. This one reads matrices of numbers only, and checks
each size before use.

Source:
    MathWorks, "MAT-File Format", level 5.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

_HEADER = 128
_COMPRESSED, _MATRIX = 15, 14
# Types of stored numbers.
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
# Classes of variables: those of numbers by type, the others by name.
_NUMBERS = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_OTHERS = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", 16: "function", 17: "object"}
_COMPLEX = 0x0800
# Bytes of a compressed variable in which its class, its shape and its name stand.
_BEGIN = 4096


class DamagedError(ValueError):
    """A file that breaks its format."""


@dataclass(frozen=True)
class Variable:
    """One variable of a file.

    Args:
        name: Its name.
        shape: Its dimensions.
        kind: NumPy type of its class; or the word for a class without numbers.
        start: Position of its element in the file [bytes].
        size: Size of the element, without its tag [bytes].
        compressed: Whether the element is compressed.
    """

    name: str
    shape: tuple[int, ...]
    kind: str
    start: int
    size: int
    compressed: bool

    @property
    def numeric(self) -> bool:
        """True for a matrix of real numbers."""
        return self.kind in _NUMBERS.values()

    @property
    def bytes(self) -> int:
        """Size in memory as float64 [bytes]."""
        return 8 * math.prod(self.shape)


class MatFile:
    """A MATLAB file of level 5, in memory.

    Args:
        content: The bytes of the file.

    Raises:
        DamagedError: If the bytes are not those of such a file.
    """

    def __init__(self, content: bytes):
        self._content = content
        self._order = {b"IM": "<", b"MI": ">"}.get(content[126:_HEADER], "")
        if not self._order:
            _fail("it has no header of a MATLAB file")
        self.variables: dict[str, Variable] = {}
        at = _HEADER
        while at < len(content):
            kind, size, start = self._tag(content, at)
            if start + size > len(content):
                _fail(f"an element at byte {at} ends beyond the file")
            # Elements that are not compressed are filled up to 8 bytes.
            at = start + (size if kind == _COMPRESSED else -(-size // 8) * 8)
            if kind in (_MATRIX, _COMPRESSED) and size:
                self._add(start, size, kind == _COMPRESSED)

    def _add(self, start: int, size: int, compressed: bool) -> None:
        body = self._body(start, size, compressed, _BEGIN)
        variable, _ = self._begin(body, start, size, compressed)
        if variable.name in self.variables:
            _fail(f"variable '{variable.name}' is there twice")
        self.variables[variable.name] = variable

    def read(self, name: str) -> np.ndarray:
        """Return a matrix of numbers.

        Raises:
            DamagedError: If its data are not those of its shape.
        """
        variable = self.variables[name]
        # A tag for each part, and numbers of at most 8 bytes.
        most = _BEGIN + variable.bytes
        body = self._body(variable.start, variable.size, variable.compressed, most)
        at = self._begin(body, variable.start, variable.size, variable.compressed)[1]
        kind, size, at = self._tag(body, at)
        if kind not in _STORED:
            _fail(f"the data of '{name}' are of the unknown type {kind}")
        stored = np.dtype(self._order + _STORED[kind])
        if size != math.prod(variable.shape) * stored.itemsize or at + size > len(body):
            _fail(f"the data of '{name}' are not those of its shape {variable.shape}")
        values = np.frombuffer(body, stored, math.prod(variable.shape), at)
        return values.astype(variable.kind).reshape(variable.shape, order="F")

    def _body(self, start: int, size: int, compressed: bool, most: int) -> bytes:
        """Return up to `most` bytes of a matrix, without its tag."""
        if not compressed:
            return self._content[start : start + min(size, most)]
        body = zlib.decompressobj().decompress(self._content[start : start + size], most + 8)
        kind, _, at = self._tag(body, 0)
        if kind != _MATRIX:
            _fail(f"a compressed element is of type {kind}")
        return body[at:]

    def _begin(self, body: bytes, start: int, size: int, compressed: bool) -> tuple[Variable, int]:
        """Read class, shape and name; return them and the place at which the data begin."""
        flags, at = self._part(body, 0, (6,))
        dimensions, at = self._part(body, at, (5,))
        letters, at = self._part(body, at, (1, 2, 16))
        if len(flags) != 8 or not dimensions or len(dimensions) % 4:
            _fail("the head of a variable is damaged")
        word = int(np.frombuffer(flags, f"{self._order}u4")[0])
        shape = tuple(int(n) for n in np.frombuffer(dimensions, f"{self._order}i4"))
        if min(shape) < 0:
            _fail(f"a variable has the shape {shape}")
        known = _NUMBERS.get(word & 0xFF) or _OTHERS.get(word & 0xFF, "of an unknown class")
        kind = "complex" if word & _COMPLEX and word & 0xFF in _NUMBERS else known
        return Variable(letters.decode("latin-1"), shape, kind, start, size, compressed), at

    def _part(self, body: bytes, at: int, kinds: tuple[int, ...]) -> tuple[bytes, int]:
        """Return the data of one part of a variable, and the place of the next."""
        kind, size, start = self._tag(body, at)
        if kind not in kinds or start + size > len(body):
            _fail("the head of a variable is damaged")
        # A short part stands in its tag.
        end = at + 8 if start == at + 4 else start + -(-size // 8) * 8
        return body[start : start + size], end

    def _tag(self, body: bytes, at: int) -> tuple[int, int, int]:
        """Return type, size and place of the data of an element."""
        if at + 8 > len(body):
            _fail("it ends within an element")
        first, second = (int(n) for n in np.frombuffer(body, f"{self._order}u4", 2, at))
        if first >> 16:
            if first >> 16 > 4:
                _fail(f"a short element at byte {at} has {first >> 16} bytes")
            return first & 0xFFFF, first >> 16, at + 4
        return first, second, at + 8


def _fail(what: str) -> NoReturn:
    raise DamagedError(what)

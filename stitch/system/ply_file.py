"""PLY files as NumPy tables: read in every encoding with every property, written as binary little endian.

Format: Turk 1994, "The PLY polygon file format": a header of elements with their properties, then the elements one
after the other, in text or in binary of either byte order. A property is a number, or a list that begins with its
length.
"""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Types of numbers as NumPy and as headers call them: by their old names, and by those that say their size.
_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_OLD_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_SIZED_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_TYPES = dict(zip(_OLD_NAMES + _SIZED_NAMES, 2 * _CODES, strict=True))
_NAMES = dict(zip(_CODES, _OLD_NAMES, strict=True))
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
# A header of more bytes is none.
_LONGEST_HEADER = 1 << 20


class PlyError(ValueError):
    """A file that is no PLY, or ends before what its header announces."""


class Lists(NamedTuple):
    """A property that is a list in each of N elements."""

    lengths: NDArray[np.int64]  # (N,)
    values: NDArray[Any]  # (sum of lengths,)


Columns = dict[str, NDArray[Any] | Lists]


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str  # "f4" …
    length_kind: str = ""  # of a list


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(p.length_kind for p in self.properties)

    def layout(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(p.name, order + p.kind) for p in self.properties])


def read_ply(path: Path) -> dict[str, Columns]:
    """Return element -> property -> column of a file: numbers (N,), or `Lists` where the property is a list.

    Numbers of a binary file whose element has no lists are a memory map of the file; writes do not reach it.

    Raises:
        PlyError: the header cannot be read, or the file ends early.
    """
    with path.open("rb") as stream:
        encoding, elements = _read_header(stream)
        tables = dict[str, Columns]()
        for element in elements:
            if encoding == "ascii":
                tables[element.name] = _read_text(stream, element)
            elif element.has_lists:
                tables[element.name] = _read_binary_lists(stream, element, _BYTE_ORDERS[encoding])
            else:
                tables[element.name] = _map_numbers(path, stream, element, _BYTE_ORDERS[encoding])
    return tables


def vertex_columns(path: Path) -> dict[str, NDArray[Any]]:
    """Return the numbers (N,) of the vertices by name; lists have no column of numbers.

    Raises:
        PlyError: as `read_ply`, or the file has no vertices.
    """
    tables = read_ply(path)
    if "vertex" not in tables:
        raise PlyError("no element is called vertex")
    return {name: column for name, column in tables["vertex"].items() if not isinstance(column, Lists)}


def write_ply(path: Path, elements: Mapping[str, NDArray[np.void]]) -> None:
    """Write element name -> structured array (N,) as a binary little endian PLY; its fields are the properties.

    A field of k numbers becomes a list of length k.
    """
    with path.open("wb") as out:
        out.write(ply_header({name: (rows.dtype, len(rows)) for name, rows in elements.items()}))
        for rows in elements.values():
            packed(rows).tofile(out)


def ply_header(elements: Mapping[str, tuple[np.dtype[np.void], int]]) -> bytes:
    """Return the header of a binary little endian PLY, from element name -> (dtype of a row, number of rows)."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element, (layout, count) in elements.items():
        lines.append(f"element {element} {count}")
        for name in layout.names or ():
            kind = _NAMES[layout[name].base.str[1:]]
            lines.append(f"property list uchar {kind} {name}" if layout[name].shape else f"property {kind} {name}")
    return "\n".join([*lines, "end_header", ""]).encode()


def packed(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return a structured array in the layout of a binary file: little endian, each list after its length as a byte.

    Args:
        rows: (N,) with fields of single numbers and of k numbers, which become lists of length k.
    """
    fields = list[tuple[str, Any]]()
    for name in rows.dtype.names or ():
        kind = rows.dtype[name].base.newbyteorder("<")
        if rows.dtype[name].shape:
            fields.append((f"{name} length", "u1"))
        fields.append((name, (kind, rows.dtype[name].shape)))
    if np.dtype(fields) == rows.dtype:
        return rows
    table = np.empty(len(rows), fields)
    for name in rows.dtype.names or ():
        table[name] = rows[name]
        if rows.dtype[name].shape:
            table[f"{name} length"] = math.prod(rows.dtype[name].shape)
    return table


def _read_header(stream: BinaryIO) -> tuple[str, list[_Element]]:
    """Return the encoding, a key of `_BYTE_ORDERS`, and the elements; the stream moves to the first byte of data.

    Raises:
        PlyError: it is no PLY, or a line cannot be read.
    """
    if stream.readline(_LONGEST_HEADER).strip() != b"ply":
        raise PlyError("does not begin with ply")
    encoding = ""
    elements = list[_Element]()
    while True:
        line = stream.readline(_LONGEST_HEADER)
        words = line.decode("ascii", "replace").split()
        match words:
            case ["end_header"]:
                break
            case ["format", encoding, _] if encoding in _BYTE_ORDERS:
                pass
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length_kind, kind, name] if elements and {length_kind, kind} <= _TYPES.keys():
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length_kind]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case ["format" | "element" | "property", *_]:
                raise PlyError(f"a header line cannot be read: {' '.join(words)[:80]!r}")
            case _ if not line:
                raise PlyError("no end_header")
    if not encoding:
        raise PlyError("no line says the format")
    return encoding, elements


def _map_numbers(path: Path, stream: BinaryIO, element: _Element, order: str) -> Columns:
    """Return property -> numbers (N,) of a binary element without lists, as a memory map of the file at `path`.

    Args:
        stream: the same file, at the element's first byte; it moves to the byte after its last.
        order: "<" or ">", as in dtypes.

    Raises:
        PlyError: the file ends early.
    """
    layout = element.layout(order)
    start = stream.tell()
    size = layout.itemsize * element.count
    if os.fstat(stream.fileno()).st_size - start < size:
        raise PlyError(f"ends early: {element.count} of {element.name} are announced")
    stream.seek(start + size)
    if not size:
        rows = np.empty(element.count, layout)
    else:
        # Copy on write: whoever changes a column changes none of the file.
        rows = np.memmap(path, layout, mode="c", offset=start, shape=(element.count,))
    return {p.name: rows[p.name] for p in element.properties}


def _read_binary_lists(stream: BinaryIO, element: _Element, order: str) -> Columns:
    """Return property -> column of a binary element with lists; the stream moves to the byte after the element.

    Where all lists of a property are as long as the first, all rows have one layout and are read at once; else each
    row is walked.

    Args:
        order: "<" or ">", as in dtypes.
    """
    start = stream.tell()
    data = stream.read()
    first_row, _ = _walk_rows(data, replace(element, count=min(element.count, 1)), order)
    lengths = {name: int(column.lengths.sum()) for name, column in first_row.items() if isinstance(column, Lists)}
    layout = np.dtype(_fields_of_row(element, order, lengths))
    if layout.itemsize * element.count <= len(data):
        rows: NDArray[np.void] = np.frombuffer(data, layout, element.count)
        if all((rows[f"{name} length"] == length).all() for name, length in lengths.items()):
            stream.seek(start + layout.itemsize * element.count)
            return {
                name: Lists(rows[f"{name} length"].astype(np.int64), rows[name].reshape(-1))
                if name in lengths
                else rows[name]
                for name in first_row
            }
    columns, size = _walk_rows(data, element, order)
    stream.seek(start + size)
    return columns


def _fields_of_row(element: _Element, order: str, lengths: Mapping[str, int]) -> list[tuple[str, Any]]:
    """Return the fields of a dtype for one row: each list property of fixed length, after a field for that length.

    Args:
        order: "<" or ">", as in dtypes.
        lengths: list property -> its number of values.
    """
    fields = list[tuple[str, Any]]()
    for p in element.properties:
        if p.length_kind:
            fields.append((f"{p.name} length", order + p.length_kind))
        fields.append((p.name, (order + p.kind, (lengths[p.name],))) if p.length_kind else (p.name, order + p.kind))
    return fields


def _walk_rows(data: bytes, element: _Element, order: str) -> tuple[Columns, int]:
    """Return property -> column of an element with lists, read row by row, and how many bytes all rows take.

    Args:
        data: bytes from the element's first one on; more may follow.
        order: "<" or ">", as in dtypes.

    Raises:
        PlyError: the data end early.
    """
    big = "big" if order == ">" else "little"
    steps = [(p.name, int(p.length_kind[1:]) if p.length_kind else 0, int(p.kind[1:])) for p in element.properties]
    lengths: dict[str, list[int]] = {p.name: [] for p in element.properties}
    parts: dict[str, list[bytes]] = {p.name: [] for p in element.properties}
    at = 0
    for _ in range(element.count):
        for name, length_bytes, number_bytes in steps:
            length = int.from_bytes(data[at : at + length_bytes], big) if length_bytes else 1  # type: ignore[arg-type]
            start = at + length_bytes
            at = start + length * number_bytes
            lengths[name].append(length)
            parts[name].append(data[start:at])
        if at > len(data):
            raise PlyError(f"ends early: {element.count} of {element.name} are announced")
    columns = Columns()
    for p in element.properties:
        values = np.array(np.frombuffer(b"".join(parts[p.name]), order + p.kind))
        columns[p.name] = Lists(np.array(lengths[p.name], np.int64), values) if p.length_kind else values
    return columns, at


def _read_text(stream: BinaryIO, element: _Element) -> Columns:
    """Return property -> column of an element in text, one line a row; the stream moves behind its lines.

    Raises:
        PlyError: too few lines, a line of another length, or a word that is no number.
    """
    if not element.count:
        none = np.empty(0)
        return {p.name: Lists(np.empty(0, np.int64), none) if p.length_kind else none for p in element.properties}
    try:
        if not element.has_lists:
            table = np.loadtxt(stream, ndmin=2, max_rows=element.count, comments=None, encoding="ascii")
            if table.shape != (element.count, len(element.properties)):
                raise PlyError(
                    f"{len(table)} rows of {table.shape[1]} numbers in place of {element.count} of "
                    f"{len(element.properties)} ({element.name})"
                )
            return {p.name: table[:, k].astype(p.kind) for k, p in enumerate(element.properties)}
        return _read_text_lists(stream, element)
    except (ValueError, IndexError) as error:
        raise PlyError(f"{element.name}: {error}") from error


def _read_text_lists(stream: BinaryIO, element: _Element) -> Columns:
    """Return property -> column of an element in text some of whose properties are lists, one line a row.

    Raises:
        PlyError: a line is longer than its lists say.
        ValueError, IndexError: a word is missing or no number.
    """
    numbers: dict[str, list[str]] = {p.name: [] for p in element.properties}
    lengths: dict[str, list[int]] = {p.name: [] for p in element.properties if p.length_kind}
    for _ in range(element.count):
        words = stream.readline().decode("ascii").split()
        at = 0
        for p in element.properties:
            length = 1
            if p.length_kind:
                length = int(words[at])
                lengths[p.name].append(length)
                at += 1
            numbers[p.name] += words[at : at + length]
            at += length
        if at != len(words):
            raise PlyError(f"a row has {len(words)} words in place of {at}")
    columns = Columns()
    for p in element.properties:
        values = np.array(numbers[p.name], float).astype(p.kind)
        columns[p.name] = Lists(np.array(lengths[p.name], np.int64), values) if p.length_kind else values
    return columns

"""PCD files: ascii, binary and binary_compressed, padding fields and counts too.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

import io
import struct
from pathlib import Path

import numpy as np

from stitch.errors import InputError, NothingMeasuredError
from stitch.numerics.frames import Array

_KINDS = {"F": "f", "U": "u", "I": "i"}
_HEADER_BYTES = 65536
# LZF packs no more bytes than 264 into three.
_MOST_PACKED = 90


def read_pcd(path: Path) -> dict[str, Array]:
    """Return columns by field name, (N,) each; padding ("_") and fields with a count above 1 are skipped.

    Raises:
        InputError: header or data do not fit together.
    """
    raw = path.read_bytes()
    header, encoding, start = _header(path, raw)
    layout, count = _binary_layout(path, header)
    # Name -> number of the field as text, its name in the layout: several fields of padding share one name "_".
    kept = {name: str(i) for i, name in enumerate(header["FIELDS"]) if not layout[i].shape and name != "_"}
    body = raw[start:]
    if encoding == "ascii":
        return _ascii_columns(path, body, layout, count, kept)
    if encoding == "binary":
        if len(body) < layout.itemsize * count:
            raise InputError(_cut_short(path, count, len(body) // layout.itemsize))
        table = np.frombuffer(body, layout, count)
        return {name: table[field] for name, field in kept.items()}
    if encoding == "binary_compressed":
        return _compressed_columns(path, body, layout, count, kept)
    raise InputError(f"{path}: PCD DATA {encoding!r} is unknown; use ascii, binary or binary_compressed")


def _header(path: Path, raw: bytes) -> tuple[dict[str, list[str]], str, int]:
    """Return the header as first word of a line -> its other words, the encoding, and the byte where the data begin.

    Raises:
        InputError: no line DATA.
    """
    header: dict[str, list[str]] = {}
    start = 0
    while True:
        end = raw.find(b"\n", start)
        if end < 0 or start > _HEADER_BYTES:
            raise InputError(f"{path}: no DATA line; this is not a PCD file")
        words = raw[start:end].decode("ascii", "replace").split()
        start = end + 1
        if len(words) > 1 and words[0] == "DATA":
            return header, words[1], start
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]


def _binary_layout(path: Path, header: dict[str, list[str]]) -> tuple[np.dtype[np.void], int]:
    """Return the dtype of one point, its fields called "0", "1" … in their order, and the number of points.

    Raises:
        InputError: the header lacks an entry, or holds a wrong number.
    """
    try:
        fields = header["FIELDS"]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(fields))]
        kinds = [_KINDS[t] + s for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
        count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        if count < 0 or min(counts) < 1:
            raise ValueError("a negative number of points or values")
        columns = zip(fields, kinds, counts, strict=True)
        layout = [(f"{i}", f"<{kind}", (c,) if c > 1 else ()) for i, (_, kind, c) in enumerate(columns)]
        return np.dtype(layout), count
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: PCD header is incomplete ({error}); it needs FIELDS, SIZE, TYPE and POINTS"
        ) from None


def _ascii_columns(
    path: Path, body: bytes, layout: np.dtype[np.void], count: int, kept: dict[str, str]
) -> dict[str, Array]:
    """Return columns (N,) by field name of data that are text, a line for each point.

    Args:
        body: the file after its header.
        layout: the fields of a point; one with a shape takes as many columns of text as it has values.
        count: N, the points that the header announces.
        kept: names of the fields to return, with their number in the layout.

    Raises:
        InputError: no points, or fewer than announced.
    """
    # A header may announce more than memory holds: the lines that are there limit what is made room for.
    rows = min(count, body.count(b"\n") + 1)
    if not body.strip():
        raise NothingMeasuredError(f"{path}: no points; leave this view out of views.csv or scan it again")
    widths = [int(np.prod(layout[name].shape)) for name in layout.names or ()]
    table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=rows).reshape(-1, sum(widths))
    if len(table) < count:
        raise InputError(_cut_short(path, count, len(table)))
    first_columns = np.concatenate([[0], np.cumsum(widths)])
    return {name: table[:, first_columns[int(field)]] for name, field in kept.items()}


def _compressed_columns(
    path: Path, body: bytes, layout: np.dtype[np.void], count: int, kept: dict[str, str]
) -> dict[str, Array]:
    """Return columns (N,) by field name of data that are LZF-compressed, and stored field by field.

    Args:
        body: the file after its header: packed size, size, packed bytes.
        layout: the fields of a point.
        count: N, the points that the header announces.
        kept: names of the fields to return, with their number in the layout.

    Raises:
        InputError: the bytes are fewer than announced, or unpack to another number of points.
    """
    packed, size = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, 0)
    if size != layout.itemsize * count or len(body) < 8 + packed or size > _MOST_PACKED * packed:
        raise InputError(f"{path}: compressed data are cut short; export it again")
    import lzf  # few PCD files are packed

    data = lzf.decompress(body[8 : 8 + packed], size) if size else b""
    if data is None or len(data) != size:
        raise InputError(f"{path}: compressed data do not give its {count} points; export it again")
    sizes = [layout[name].itemsize for name in layout.names or ()]
    first = np.concatenate([[0], np.cumsum(sizes)]) * count
    return {name: np.frombuffer(data, layout[field], count, int(first[int(field)])) for name, field in kept.items()}


def _cut_short(path: Path, announced: int, found: int) -> str:
    return f"{path}: {announced} points announced, data for {found}; export it again"

"""PCD files: ascii, binary and binary_compressed, padding fields and counts too.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

import io
import struct
from pathlib import Path

import lzf
import numpy as np

from stitch.errors import InputError
from stitch.frames import Array

_KINDS = {"F": "f", "U": "u", "I": "i"}


def read_pcd(path: Path) -> dict[str, Array]:
    """Columns by field name, (N,) each; padding ("_") and fields with a count above 1 are skipped.

    Raises:
        InputError: header or data do not fit together.
    """
    raw = path.read_bytes()
    header, encoding, start = _header(path, raw)
    layout, count = _binary_layout(path, header)
    body = raw[start:]
    if encoding == "ascii":
        return _ascii(path, body, header, count)
    if encoding == "binary":
        need = layout.itemsize * count
        if len(body) < need:
            raise InputError(
                f"{path}: {count} points announced, data for {len(body) // layout.itemsize}; export it again"
            )
        table = np.frombuffer(body, layout, count)
        return {name: table[str(i)] for name, i in _scalar_fields(header).items()}
    if encoding == "binary_compressed":
        return _compressed(path, body, header, layout, count)
    raise InputError(f"{path}: PCD DATA {encoding!r} is unknown; use ascii, binary or binary_compressed")


def _header(path: Path, raw: bytes) -> tuple[dict[str, list[str]], str, int]:
    header: dict[str, list[str]] = {}
    start = 0
    while True:
        end = raw.find(b"\n", start)
        if end < 0 or start > 65536:
            raise InputError(f"{path}: no DATA line; this is not a PCD file")
        words = raw[start:end].decode("ascii", "replace").split()
        start = end + 1
        if len(words) > 1 and words[0] == "DATA":
            return header, words[1], start
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]


def _binary_layout(path: Path, header: dict[str, list[str]]) -> tuple[np.dtype[np.void], int]:
    try:
        fields = header["FIELDS"]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(fields))]
        kinds = [_KINDS[t] + s for t, s in zip(header["TYPE"], header["SIZE"], strict=True)]
        count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        if count < 0 or min(counts) < 1:
            raise ValueError("a negative number of points or values")
        columns = zip(kinds, counts, strict=True)
        return np.dtype([(f"{i}", "<" + k, (c,) if c > 1 else ()) for i, (k, c) in enumerate(columns)]), count
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: PCD header is incomplete ({error}); it needs FIELDS, SIZE, TYPE and POINTS"
        ) from None


def _counts(header: dict[str, list[str]]) -> list[int]:
    return [int(c) for c in header.get("COUNT", ["1"] * len(header["FIELDS"]))]


def _scalar_fields(header: dict[str, list[str]]) -> dict[str, int]:
    """Field name -> position in FIELDS, without padding and vectors."""
    fields = zip(header["FIELDS"], _counts(header), strict=True)
    return {name: i for i, (name, count) in enumerate(fields) if count == 1 and name != "_"}


def _ascii(path: Path, body: bytes, header: dict[str, list[str]], count: int) -> dict[str, Array]:
    counts = _counts(header)
    rows = min(count, body.count(b"\n") + 1)
    if not body.strip():
        raise InputError(f"{path}: no points; leave this view out of views.csv or scan it again")
    table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=rows).reshape(-1, sum(counts))
    if len(table) < count:
        raise InputError(f"{path}: {count} points announced, data for {len(table)}; export it again")
    first = np.concatenate([[0], np.cumsum(counts)])
    return {name: table[:, first[i]] for name, i in _scalar_fields(header).items()}


def _compressed(
    path: Path, body: bytes, header: dict[str, list[str]], layout: np.dtype[np.void], count: int
) -> dict[str, Array]:
    """LZF-compressed, and stored field by field."""
    packed, size = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, 0)
    if size != layout.itemsize * count or len(body) < 8 + packed:
        raise InputError(f"{path}: compressed data are cut short; export it again")
    data = lzf.decompress(body[8 : 8 + packed], size) if size else b""
    if data is None or len(data) != size:
        raise InputError(f"{path}: compressed data do not give its {count} points; export it again")
    sizes = [layout[name].itemsize for name in layout.names or ()]
    first = np.concatenate([[0], np.cumsum(sizes)]) * count
    return {name: np.frombuffer(data, layout[i], count, int(first[i])) for name, i in _scalar_fields(header).items()}

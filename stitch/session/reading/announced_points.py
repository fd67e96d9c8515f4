"""How many points a scan's header announces, asked before a library makes room for them: LAS, E57, EXR, HDF5.

Layouts: LAS 1.4 R15 (ASPRS), tables 3 and 4; ASTM E2807, clause 6; OpenEXR, "The OpenEXR file layout".
"""

import re
import struct
from pathlib import Path

from stitch.errors import InputError

# No scan of one view has more.
MOST_POINTS = 200_000_000
# Deflate packs 1032 bytes into one at most.
_POINTS_A_BYTE = 1000
_LAS_HEADER = 375
_LAS_VERSION = 24
_LAS_RECORD = 105  # length of a record and, in versions before 1.4, their number
_LAS_COUNT_14 = 247
_E57_HEADER = 48
_E57_XML = 24  # where the XML stands, how long it is, and the size of a page
_E57_CHECKSUM = 4  # bytes at the end of a page
# The description stands before the pixels; texts in it are short.
_EXR_HEADER = 1 << 20
_EXR_WINDOW = b"dataWindow\0box2i\0" + struct.pack("<I", 16)


def require_room(path: Path, points: int) -> None:
    """Refuse a file whose header announces more points than its bytes can hold, compressed or not.

    Asked before a library allocates memory for them.

    Args:
        points: number that the header announces.

    Raises:
        InputError: names that number.
    """
    size = path.stat().st_size
    if points > min(MOST_POINTS, _POINTS_A_BYTE * size):
        raise InputError(f"{path}: {points} points announced in {size} bytes; export it again, a file a view")


def require_las_room(path: Path) -> None:
    """Refuse a LAS or LAZ whose header announces more points than it can hold; see `require_room`."""
    with path.open("rb") as stream:
        head = stream.read(_LAS_HEADER)
    if len(head) < _LAS_RECORD + 6 or head[:4] != b"LASF":
        return
    length, points = struct.unpack_from("<HI", head, _LAS_RECORD)
    if tuple(head[_LAS_VERSION : _LAS_VERSION + 2]) >= (1, 4) and len(head) >= _LAS_COUNT_14 + 8:
        points = max(points, *struct.unpack_from("<Q", head, _LAS_COUNT_14))
    require_room(path, points)
    size = path.stat().st_size
    if path.suffix.lower() == ".las" and points * max(length, 1) > size:
        raise InputError(f"{path}: {points} points announced in {size} bytes; export it again")


def require_e57_room(path: Path) -> None:
    """Refuse an E57 one of whose scans announces more points than it can hold; see `require_room`.

    The XML that describes the scans lies in pages of the file, each of which ends with a checksum.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_E57_HEADER)
        if len(head) < _E57_HEADER or head[:8] != b"ASTM-E57":
            return
        start, length, page = struct.unpack_from("<QQQ", head, _E57_XML)
        if start + length > size or page <= _E57_CHECKSUM:
            raise InputError(f"{path}: {length} bytes of description announced in {size}; export it again")
        stream.seek(start)
        raw = stream.read()
    first = page - start % page
    pages = [raw[:first], *(raw[i : i + page] for i in range(first, len(raw), page))]
    text = b"".join(piece[:-_E57_CHECKSUM] for piece in pages)[:length]
    counts = re.findall(rb'recordCount\s*=\s*["\']\s*([^"\']*)', text)
    # XML entities could hide a number, or unpack to a text of any length: files with entities are refused.
    if b"<!" in text.replace(b"<!--", b"").replace(b"<![CDATA[", b"") or not all(count.isdigit() for count in counts):
        raise InputError(f"{path}: its description has entities, or a number of points that is none; export it again")
    require_room(path, max(map(int, counts), default=0))


def require_exr_room(path: Path) -> None:
    """Refuse an OpenEXR image of more pixels than it can hold; see `require_room`."""
    with path.open("rb") as stream:
        head = stream.read(_EXR_HEADER)
    windows = [found.end() for found in re.finditer(re.escape(_EXR_WINDOW), head) if found.end() <= len(head) - 16]
    for at in windows:
        left, top, right, bottom = struct.unpack_from("<4i", head, at)
        require_room(path, max(right - left + 1, 0) * max(bottom - top + 1, 0))
    if not windows:
        raise InputError(f"{path}: has no dataWindow where the description of an OpenEXR stands; export it again")

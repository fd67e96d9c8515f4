"""Headers that announce more than their file holds are refused in a line, before room is made."""

import struct
import time

import numpy as np
import pytest

from stitch.errors import InputError
from stitch.session.reading.announced_points import (
    require_e57_room,
    require_exr_room,
    require_las_room,
    require_room,
)
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.scan_files import ptx_scans
from tests.needs import needs

MANY = 10**12


def las(count, version=(1, 4), length=20, body=0):
    head = bytearray(375)
    head[:4] = b"LASF"
    head[24:26] = bytes(version)
    struct.pack_into("<HI", head, 105, length, count if version < (1, 4) else 0)
    if version >= (1, 4):
        struct.pack_into("<Q", head, 247, count)
    return bytes(head) + bytes(body)


def e57(count, page=1024, pad=0, length=None):
    text = b"<e57Root>" + b" " * pad + f'<points type="CompressedVector" recordCount="{count}"/></e57Root>'.encode()
    logical = bytes(48) + text
    pages = [logical[i : i + page - 4] for i in range(0, len(logical), page - 4)]
    raw = b"".join(piece.ljust(page - 4, b"\0") + b"####" for piece in pages)
    head = b"ASTM-E57" + struct.pack("<IIQQQQ", 1, 0, len(raw), 48, len(text) if length is None else length, page)
    return head + raw[48:]


def exr(width, height):
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    return struct.pack("<II", 20000630, 2) + b"dataWindow\0box2i\0" + struct.pack("<I", 16) + window + b"\0"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("s.las", las(MANY)),
        ("s.las", las(2**32 - 1, (1, 2))),
        ("s.las", las(5000, body=90_000)),
        ("s.laz", las(MANY)),
        ("s.e57", e57(MANY)),
        ("s.e57", e57(MANY, pad=1024 - 4 - 48 - 9 - 40)),  # the number goes over the edge of a page
        ("s.e57", e57(10, length=MANY)),
        ("s.pts", b"%d\n1 2 3\n" % MANY),
        ("s.ptx", b"1000000\n1000000\n" + b"0 0 0\n" * 4 + b"1 0 0 0\n" * 4 + b"1 2 3 4\n" * 3),
        ("s.ptx", b"-10\n1\n" + b"0 0 0\n" * 12),
        ("s.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nend_header\n" % MANY),
        ("s.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS %d\nDATA binary\n" % MANY),
        (
            "s.pcd",
            b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 300000000\nDATA binary_compressed\n"
            + struct.pack("<II", 3, 3_600_000_000 % 2**32)
            + b"abc",
        ),
    ],
)
def test_a_header_that_announces_too_much_is_refused_at_once(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    began = time.process_time()
    with pytest.raises(InputError) as refused:
        read_cloud(tmp_path / name)
    assert str(refused.value).startswith(str(tmp_path / name)) and "\n" not in str(refused.value)
    assert "not installed" not in str(refused.value) and time.process_time() - began < 2.0


def test_an_array_that_announces_too_much_is_refused_at_once(tmp_path):
    np.save(tmp_path / "s.npy", np.zeros((7, 3)))
    content = (tmp_path / "s.npy").read_bytes()
    (tmp_path / "s.npy").write_bytes(content.replace(b"(7, 3), }" + b" " * 12, b"(1000000000000, 3), }"))
    with pytest.raises(InputError, match=r"s\.npy"):
        read_cloud(tmp_path / "s.npy")


def test_an_image_that_announces_too_much_is_refused_before_it_is_decoded(tmp_path):
    (tmp_path / "d.exr").write_bytes(exr(1_000_000, 1_000_000))
    with pytest.raises(InputError, match="1000000000000 points announced"):
        require_exr_room(tmp_path / "d.exr")
    # A first window that is small, and one that stands far behind.
    small, large = exr(4, 4)[:-1], exr(1_000_000, 1_000_000)[8:]
    text = b"pad\0string\0" + struct.pack("<I", 70_000) + bytes(70_000)
    (tmp_path / "d.exr").write_bytes(small + text + large)
    with pytest.raises(InputError, match="1000000000000 points announced"):
        require_exr_room(tmp_path / "d.exr")


@pytest.mark.parametrize("number", [b"&#49;000000000000", b"&many;", b"-5", b""])
def test_a_number_of_points_that_is_spelt_otherwise_is_refused(tmp_path, number):
    (tmp_path / "s.e57").write_bytes(e57(10).replace(b'"10"', b'"' + number + b'"'))
    with pytest.raises(InputError, match="number of points that is none"):
        require_e57_room(tmp_path / "s.e57")


def test_what_a_file_can_hold_passes(tmp_path):
    for name, content, check in (
        ("s.las", las(5000, body=100_000), require_las_room),
        ("s.laz", las(300_000), require_las_room),
        ("s.e57", e57(900_000), require_e57_room),
        ("d.exr", exr(64, 48), require_exr_room),
    ):
        (tmp_path / name).write_bytes(content)
        check(tmp_path / name)
    with pytest.raises(InputError, match="201000000 points announced"):
        (tmp_path / "large").write_bytes(bytes(300_000))
        require_room(tmp_path / "large", 201_000_000)


def test_the_window_of_a_written_exr_is_found(tmp_path):
    OpenEXR = needs("OpenEXR", "formats")
    pixels = {"Z": np.full((48, 64), 400.0, "f4")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, pixels) as file:
        file.write(str(tmp_path / "d.exr"))
    require_exr_room(tmp_path / "d.exr")
    content = (tmp_path / "d.exr").read_bytes()
    window = struct.pack("<4i", 0, 0, 63, 47)
    (tmp_path / "d.exr").write_bytes(content.replace(window, struct.pack("<4i", 0, 0, 999_999, 999_999), 1))
    with pytest.raises(InputError, match="points announced"):
        require_exr_room(tmp_path / "d.exr")


def test_sizes_below_zero_do_not_read_a_ptx_for_ever(tmp_path):
    (tmp_path / "s.ptx").write_text("-10\n1\n1 2 3\n")
    with pytest.raises(InputError, match="-10 columns of 1 points"):
        ptx_scans(tmp_path / "s.ptx")

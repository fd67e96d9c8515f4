"""PLY files against another library, in every encoding, with every type of number and with lists."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from stitch.system.ply_file import Lists, PlyError, read_ply, vertex_columns, write_ply

KINDS = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
ENCODINGS = [(True, "="), (False, "<"), (False, ">")]


def numbers_of_every_kind(count: int) -> np.ndarray:
    rng = np.random.default_rng(count)
    rows = np.empty(count, [(f"of_{kind}", kind) for kind in KINDS])
    for kind in KINDS:
        limits = None if kind[0] == "f" else np.iinfo(kind)
        values = rng.normal(size=count) if limits is None else rng.integers(limits.min, limits.max, count)
        rows[f"of_{kind}"] = values.astype(kind)
    return rows


def triangles(count: int) -> np.ndarray:
    rows = np.empty(count, [("vertex_indices", "i4", (3,)), ("flag", "u1")])
    rows["vertex_indices"] = np.arange(3 * count).reshape(-1, 3)
    rows["flag"] = 7
    return rows


def lists_of_different_lengths(count: int) -> np.ndarray:
    rows = np.empty(count, [("pixel", "O"), ("weight", "f4")])
    for k in range(count):
        rows["pixel"][k] = np.arange(k % 4, dtype="i4")
    rows["weight"] = 0.25
    return rows


@pytest.mark.parametrize(("text", "order"), ENCODINGS)
@pytest.mark.parametrize("count", [0, 1, 500])
def test_files_of_another_library_are_read_to_the_same_numbers(tmp_path, count, text, order):
    elements = [
        PlyElement.describe(numbers_of_every_kind(count), "vertex"),
        PlyElement.describe(triangles(count), "face"),
        PlyElement.describe(
            lists_of_different_lengths(count), "grid", len_types={"pixel": "u2"}, val_types={"pixel": "i4"}
        ),
    ]
    PlyData(elements, text=text, byte_order=order).write(str(tmp_path / "c.ply"))
    read, other = read_ply(tmp_path / "c.ply"), PlyData.read(str(tmp_path / "c.ply"))
    for name in other["vertex"].data.dtype.names:
        np.testing.assert_array_equal(read["vertex"][name], other["vertex"][name])
    faces, pixels = read["face"]["vertex_indices"], read["grid"]["pixel"]
    assert isinstance(faces, Lists) and isinstance(pixels, Lists)
    np.testing.assert_array_equal(faces.lengths, np.full(count, 3))
    np.testing.assert_array_equal(faces.values, np.arange(3 * count))
    np.testing.assert_array_equal(pixels.lengths, np.arange(count) % 4)
    np.testing.assert_array_equal(pixels.values, np.concatenate([np.empty(0), *other["grid"]["pixel"]]))
    np.testing.assert_array_equal(read["grid"]["weight"], other["grid"]["weight"])


@pytest.mark.parametrize("count", [0, 1, 500])
def test_files_are_written_byte_for_byte_as_another_library_writes_them(tmp_path, count):
    elements = {"vertex": numbers_of_every_kind(count), "face": triangles(count)}
    write_ply(tmp_path / "ours.ply", elements)
    PlyData([PlyElement.describe(rows, name) for name, rows in elements.items()], byte_order="<").write(
        str(tmp_path / "theirs.ply")
    )
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "theirs.ply").read_bytes()


def test_blank_lines_comments_and_unknown_remarks_in_a_header_are_passed_over(tmp_path):
    file = tmp_path / "c.ply"
    file.write_bytes(
        b"ply\r\nformat ascii 1.0\r\n\r\ncomment by hand\r\nobj_info num_cols 2\r\nelement vertex 2\r\n"
        b"property float32 x\r\nproperty uint8 grey\r\nend_header\r\n1.5 3\r\n-2 255\r\n"
    )
    columns = vertex_columns(file)
    np.testing.assert_array_equal(columns["x"], np.float32([1.5, -2]))
    np.testing.assert_array_equal(columns["grey"], [3, 255])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"plyx\n", "does not begin with ply"),
        (b"ply\nformat ascii 1.0\n", "no end_header"),
        (b"ply\nformat odd 1.0\nend_header\n", "format odd"),
        (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "format"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n", "1 rows"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\none\n", "one"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nend_header\n1234", "ends early"),
        (b"ply\nformat binary_big_endian 1.0\nelement face 2\nproperty list uchar int i\nend_header\n\1", "ends early"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nend_header\n2 1\n", "face"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty quad i\nend_header\n2 1\n", "property quad i"),
        (b"ply\nformat ascii 1.0\nelement face 0\nproperty float i\nend_header\n", "no element is called vertex"),
    ],
)
def test_what_is_no_whole_file_is_refused_in_words(tmp_path, text, said):
    (tmp_path / "c.ply").write_bytes(text)
    with pytest.raises(PlyError, match=said):
        vertex_columns(tmp_path / "c.ply")

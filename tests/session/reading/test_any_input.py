"""Whatever stands in the files of a session: it is read, or refused in one line."""

import contextlib
import json
from datetime import timedelta

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stitch.errors import InputError
from stitch.output.stored_run import read_ledger, read_result
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.session_toml import (
    cad_file,
    positive_number,
    read_crop_box,
    read_robot,
    read_scanner,
    read_session_document,
    session_name,
)
from stitch.session.reading.target_tables import read_frames, read_points
from stitch.session.reading.views_table import read_views

quick = settings(
    max_examples=60, deadline=timedelta(seconds=5), suppress_health_check=[HealthCheck.function_scoped_fixture]
)
CELL = st.one_of(
    st.floats(allow_nan=True).map(str),
    st.integers().map(str),
    st.text(max_size=8),
    st.sampled_from(["v0", "v1", "", "1"]),
)
JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


@contextlib.contextmanager
def read_or_refused():
    try:
        yield
    except InputError as error:
        assert str(error) and "\n" not in str(error)


def table(header, rows):
    def cell(text):
        return '"' + text.replace('"', '""') + '"'

    return "\n".join([",".join(header), *(",".join(cell(c) for c in row) for row in rows)])


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "csv"])
@quick
@given(data=st.data())
def test_bytes_that_are_no_cloud(tmp_path, suffix, data):
    start = {"ply": b"ply\nformat ", "pcd": b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"}.get(suffix, b"")
    file = tmp_path / f"c.{suffix}"
    file.write_bytes(start * data.draw(st.booleans()) + data.draw(st.binary(max_size=300)))
    with read_or_refused():
        cloud = read_cloud(file)
        assert len(cloud.points) and np.isfinite(cloud.points).all()


@quick
@given(
    count=st.integers(-5, 10**15),
    encoding=st.sampled_from(["ascii", "binary", "binary_compressed"]),
    body=st.binary(max_size=200),
    sizes=st.lists(st.integers(-1, 9), min_size=3, max_size=3),
)
def test_headers_that_promise_anything(tmp_path, count, encoding, body, sizes):
    told = " ".join(map(str, sizes))
    header = f"FIELDS x y z\nSIZE {told}\nTYPE F U I\nCOUNT 1 1 1\nPOINTS {count}\nDATA {encoding}\n"
    (tmp_path / "c.pcd").write_bytes(header.encode() + body)
    kind = {"binary": "binary_little_endian"}.get(encoding, encoding)
    header = f"ply\nformat {kind} 1.0\nelement vertex {count}\nproperty float x\nproperty int y\nproperty float z\n"
    (tmp_path / "c.ply").write_bytes(header.encode() + b"end_header\n" + body)
    for name in ("c.pcd", "c.ply"):
        with read_or_refused():
            assert len(read_cloud(tmp_path / name).points) <= max(count, 0)


@quick
@given(rows=st.lists(st.lists(CELL, min_size=9, max_size=9), max_size=4), width=st.integers(1, 9))
def test_tables_of_anything(tmp_path, rows, width):
    pose = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    readers = {
        "views.csv": (["view", "cloud", *pose], lambda file: read_views(file, None)),
        "points.csv": (["view", "target", *pose], lambda file: read_points(file, ["v0", "v1"])),
        "frames.csv": (["view", "note", *pose], lambda file: read_frames(file, ["v0", "v1"])),
    }
    for name, (header, read) in readers.items():
        (tmp_path / name).write_text(table(header[: max(width, 5)] if width < 9 else header, rows), encoding="utf-8")
        with read_or_refused():
            read(tmp_path / name)


@quick
@given(text=st.text(max_size=200), value=JSON, key=st.sampled_from(["name", "scanner", "robot", "part", "sphere"]))
def test_descriptions_of_anything(tmp_path, text, value, key):
    file = tmp_path / "session.toml"
    file.write_text(f'format = "stitch-session/1"\n{text}', encoding="utf-8")
    with read_or_refused():
        read_session_document(file)
    tables = {key: value} if key == "name" else {key: value if isinstance(value, dict) else {}}
    inner = tables[key] if isinstance(tables[key], dict) else {}
    for read in (
        lambda: session_name(file, {"name": value}),
        lambda: read_scanner(file, inner | {"pose": value, "noise": value}),
        lambda: read_crop_box(file, inner | {"within": value}),
        lambda: read_robot(file, {"joints": value, "gravity": value}, "mm"),
        lambda: read_robot(file, {"joints": [{"a": value, "com": value}], "payload": value}, "mm"),
        lambda: read_robot(file, {"urdf": value}, "mm"),
        lambda: cad_file(file, {"cad": value, "cad_unit": value}),
        lambda: positive_number(file, {"radius": value}, "sphere", "radius"),
    ):
        with read_or_refused():
            read()


@quick
@given(value=JSON, key=st.sampled_from(["session", "views", "stages", "hand_eye", "effects", "notes", "convergence"]))
def test_results_of_anything(tmp_path, value, key):
    for name, read in (("result.json", read_result), ("ledger.json", read_ledger)):
        for told in (value, {key: value}, [{key: value}]):
            (tmp_path / name).write_text(json.dumps(told))
            with read_or_refused():
                read(tmp_path)

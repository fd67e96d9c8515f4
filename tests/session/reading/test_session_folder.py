"""Sessions: what is read, and the one line that every bad input gets.

Why a file is missing, what may not be read, and names that may stand in tables and name folders.
"""

import contextlib
import errno
import json
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from data_synth.fixtures.edits import edit, set_cell
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.errors import InputError
from stitch.model.model_toml import read_model
from stitch.output.stored_run import read_ledger, read_result
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.scale_checks import check_scale
from stitch.session.reading.session_folder import load_session
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
from stitch.session.reading.text_files import read_text, require_folder_name, require_name
from stitch.session.reading.views_table import read_views
from tests.command_line import ended


def test_a_good_session_is_read_whole(session):
    loaded = load_session(session)
    assert [view.name for view in loaded.views] == ["v000", "v001", "v002"]
    assert loaded.mount == "eye_to_hand"
    assert loaded.scanner.noise == 0.02
    assert np.allclose(loaded.scanner.optical_axis, [0, 0, 1])


def test_only_what_lies_within_the_stated_box_is_read(session):
    points = [view.cloud.points for view in load_session(session).views]
    deepest = max(float(np.median(own[:, 2])) for own in points)
    toml(r"\[scanner\]", f"[scanner]\nwithin = [[-1e3, -1e3, -1e3], [1e3, 1e3, {deepest}]]")(session)
    left = load_session(session, at_most=10)
    for before, view in zip(points, left.views, strict=True):
        assert view.cloud.count == int((before[:, 2] <= deepest).sum())
        whole = view.cloud.points if view.cloud.whole is None else view.cloud.whole.read().points
        assert len(whole) == view.cloud.count and whole[:, 2].max() <= deepest


def spoil_cell(row, column, value):
    """An edit of one cell of views.csv."""
    return lambda folder: set_cell(folder / "views.csv", row, column, value)


def remove(name):
    return lambda folder: (folder / name).unlink()


def column(name, *cells):
    """An edit that adds a column to views.csv."""

    def write(folder):
        rows = (folder / "views.csv").read_text().splitlines()
        own = zip(rows, [name, *cells], strict=True)
        (folder / "views.csv").write_text("\n".join(",".join(row) for row in own) + "\n")

    return write


def write_cloud(text):
    def spoil(folder):
        (folder / "clouds/v001.xyz").write_text(text)
        spoil_cell(2, "cloud", "clouds/v001.xyz")(folder)

    return spoil


def toml(old, new):
    return lambda folder: edit(folder / "session.toml", old, new)


def table(text):
    """A table more in session.toml."""
    return toml(r"\[scanner\]", f"{text}\n[scanner]")


def open_quote(folder):
    """A quote on line 3 that nobody closes, in a file larger than what csv takes for one cell."""
    rows = (folder / "views.csv").read_text().splitlines()
    (folder / "views.csv").write_text("\n".join([*rows[:2], '"' + rows[2], *rows[3:] * 2000]) + "\n")


BAD = {
    "no session.toml": (remove("session.toml"), ["session.toml", "not found"]),
    "no views.csv": (remove("views.csv"), ["views.csv", "not found"]),
    "missing cloud": (remove("clouds/v001.ply"), ["v001", "line 3", "no such cloud"]),
    "view without pose": (
        lambda f: [spoil_cell(2, c, "")(f) for c in ("x", "y", "z", "qx", "qy", "qz", "qw")], ["line 3", "v001", "no pose"]),
    "pose half given": (spoil_cell(2, "qz", ""), ["line 3", "qz"]),
    "not a number": (spoil_cell(3, "x", "12,5".replace(",", ";")), ["line 4", "x is '12;5'"]),
    "quaternion": (spoil_cell(1, "qw", "3.0"), ["line 2", "v000", "unit quaternion"]),
    "twice the same view": (spoil_cell(2, "view", "v000"), ["line 3", "line 2"]),
    "NaN in a cloud": (write_cloud("1 2 400\nnan 2 400\n"), ["v001", "1 of 2 points"]),
    "no points": (write_cloud("# x y z\n"), ["v001", "no points"]),
    "words in a cloud": (write_cloud("1 2 400\n1 two 400\n"), ["v001", "cannot be read"]),
    "not a rotation": (toml(r"pose = \[\s*\[[^,]*,", "pose = [[2.0,"), ["scanner.pose", "not a rigid motion"]),
    "metres read as millimetres": (toml('length_unit = "mm"', 'length_unit = "mm"\ncloud_unit = "m"'), ["cloud_unit", "1000", "v000"]),
    "poses in metres": (toml('length_unit = "mm"', 'length_unit = "m"\ncloud_unit = "mm"'), ["length_unit", "1000"]),
    "unknown key": (toml("standoff", "standof"), ["scanner.standof", "standoff"]),
    "wrong mount": (toml("eye_to_hand", "eye_on_hand"), ["mount", "eye_in_hand"]),
    "wrong unit": (toml('"mm"', '"cm"'), ["length_unit", "'cm'"]),
    "format": (toml("stitch-session/1", "stitch-session/9"), ["format", "stitch-session/1"]),
    "broken TOML": (toml("mount = ", "mount "), ["not valid TOML"]),
    "axis": (toml(r"\+z", "up"), ["optical_axis"]),
    "axis as a vector": (toml(r'"\+z"', "[0, 0, 1]"), ["scanner.optical_axis is [0, 0, 1]", '"+z"']),
    "axis that no effect knows": (toml(r"\+z", "-x"), ["scanner.optical_axis is '-x'", "turn the clouds"]),
    "box of one corner": (
        toml(r'"\+z"', '"+z"\nwithin = [0, 0, 300]'), ["scanner.within is [0, 0, 300]", "highest corner"]),
    "box upside down": (toml(r'"\+z"', '"+z"\nwithin = [[9, 9, 9], [0, 0, 0]]'), ["scanner.within", "highest corner"]),
    "box beside the scans": (
        toml(r'"\+z"', '"+z"\nwithin = [[0, 0, -9], [1, 1, -8]]'), ["v000", "none of its", "scanner.within", "to fix"]),
    "box of words": (
        toml(r'"\+z"', '"+z"\nwithin = [["0", "0", "0"], ["9", "9", "9"]]'), ["scanner.within", "highest corner"]),
    "payload below zero": (column("payload_kg", "5", "-3", "5"), ["line 3", "payload_kg is -3"]),
    "payload of some views": (column("payload_kg", "5", "", "5"), ["line 3", "payload_kg is ''", "every row"]),
    "sensor of no kind": (toml(r'"\+z"', '"+z"\nkind = "laser"'), ["kind is 'laser'", "'tracker'"]),
    "gravity in words": (table('[robot]\njoints = [{ a = 1 }]\ngravity = "down"'), ["session.toml", "gravity is 'down'"]),
    "URDF that is no name": (table("[robot]\nurdf = 5"), ["session.toml", "robot.urdf is 5"]),
    "link that is no name": (table('[robot]\nurdf = "r.urdf"\nflange_link = ["a"]'), ["robot.flange_link is ['a']"]),
    "CAD that is no name": (table("[part]\ncad = 5"), ["part.cad is 5"]),
    "unit of the CAD": (table('[part]\ncad_unit = "inch"'), ["cad_unit is 'inch'", "'mm' or 'm'"]),
    "open quote": (open_quote, ["views.csv line 3", "quote"]),
    "one point": (write_cloud("1 2 400\n"), ["v001", "line 3", "1 of at least 3 points"]),
    "nothing but invalid points": (write_cloud("0 0 0\n0 0 0\n"), ["v001", "line 3", "all 2 points are 0 0 0"]),
    "noise": (toml("noise = 0.02", "noise = -1"), ["scanner.noise"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_exit_2_and_leaves_nothing(session, tmp_path, name):
    spoil, expected = BAD[name]
    spoil(session)
    with pytest.raises(InputError) as error:
        load_session(session)
    assert "\n" not in str(error.value)
    for piece in expected:
        assert piece in str(error.value), str(error.value)
    told = ended("run", session, "-o", tmp_path / "out" / "run", code=2)
    assert not (tmp_path / "out").exists()
    printed = told
    assert printed.out == ""
    assert printed.err.strip() == f"stitch: {error.value}"


def test_real_sessions_are_read(shared_data):
    for name, views in (("reghec/david", 9), ("fanuc-line-sphere", 15), ("irb120-tracker", 600), ("ur10-tmac", 1495)):
        assert len(load_session(shared_data / name).views) == views


def refusal(session):
    with pytest.raises(InputError) as error:
        load_session(session)
    return str(error.value)


def test_semicolons_are_named(session):
    file = session / "views.csv"
    file.write_text(file.read_text().replace(",", ";"))
    told = refusal(session)
    assert "views.csv line 1: is separated by semicolons; to fix: save it with commas" in told
    assert f"stitch init {session} --poses {file} -o" in told and "decimal" not in told


def test_decimal_commas_are_named_with_the_semicolons(session):
    file = session / "views.csv"
    file.write_text(file.read_text().replace(",", ";").replace(".ply", "#").replace(".", ",").replace("#", ".ply"))
    assert "semicolons, with decimal commas; to fix: save it with commas between the cells and decimal points" in (
        refusal(session)
    )


def test_tabs_are_named(session):
    file = session / "views.csv"
    file.write_text(file.read_text().replace(",", "\t"))
    assert "line 1: is separated by tabs" in refusal(session)


def test_semicolons_in_the_cells_of_a_table_with_commas_are_left_alone(session):
    rows = (session / "views.csv").read_text().splitlines()
    more = ["note;n", *["a;b"] * (len(rows) - 1)]
    told = "\n".join(f"{row},{cell}" for row, cell in zip(rows, more, strict=True)) + "\n"
    (session / "views.csv").write_bytes(b"\xef\xbb\xbf" + told.encode())
    assert len(load_session(session).views) == len(rows) - 1


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_the_line_of_the_first_byte_that_is_no_utf8(session, mark):
    file = session / "views.csv"
    file.write_bytes(mark + file.read_text().replace("v001", "Fl\u00fcgel", 1).encode("latin-1"))
    assert "views.csv line 3: not UTF-8 text, byte 0xfc is" in (told := refusal(session))
    assert told.endswith("to fix: save it as CSV UTF-8")


def test_utf16_is_named(session):
    file = session / "views.csv"
    file.write_bytes(file.read_text().encode("utf-16"))
    assert refusal(session).endswith("views.csv line 1: is UTF-16 text, not UTF-8; to fix: save it as CSV UTF-8")


def test_the_description_says_its_line_too(session):
    edit(session / "session.toml", "length_unit", "# F\u00fcgung\nlength_unit")
    told = (session / "session.toml").read_text(encoding="utf-8")
    (session / "session.toml").write_bytes(told.encode("latin-1"))
    line = told.splitlines().index("# F\u00fcgung") + 1
    assert f"session.toml line {line}: not UTF-8 text" in refusal(session)


BROKEN = [
    ("view,target,x,y\nv0,a,1,2\n", "no column 'z'"),
    ("view,target,x,y,z\nv0,a,1,2,3\nv0,a,1,2,3\n", "line 3"),
    ("view,target,x,y,z\nnobody,a,1,2,3\n", "line 2"),
    ("view,target,x,y,z\nv0,a,1,two,3\n", "y is 'two'"),
    ("view,target,x,y,z,sigma\nv0,a,1,2,3,-1\n", "sigma is -1"),
    ("view,target,x,y,z\nv0,,1,2,3\n", "target is empty"),
    ("view,target,x,y,z\n", "no rows"),
]


@pytest.mark.parametrize(("text", "told"), BROKEN)
def test_broken_points_are_refused_in_one_line(text, told, tmp_path):
    session, *_ = labelled_cell(0, views=3)
    folder = write_labelled(tmp_path / "s", session)
    (folder / "points.csv").write_text(text)
    with pytest.raises(InputError, match=told) as error:
        load_session(folder)
    assert "\n" not in str(error.value)


def moved(session, change):
    """The session with its cloud's or target's points changed."""

    def view_of(view):
        if view.cloud is not None:
            return replace(view, cloud=replace(view.cloud, points=change(view.cloud.points)))
        return replace(view, sighting=replace(view.sighting, points=change(view.sighting.points)))

    return replace(session, views=tuple(view_of(view) for view in session.views))


@pytest.fixture(params=["clouds", "points"])
def right(request):
    if request.param == "clouds":
        return load_session(request.getfixturevalue("session"))
    return labelled_cell(3, views=12)[0]


def test_a_right_session_passes(right):
    check_scale(right, "mm")


def test_the_origin_may_lie_in_the_measuring_volume(right):
    """Points about the sensor's origin: the median distance is a few millimetres, the size is what it was."""
    middle = np.mean([
        np.mean(v.cloud.points if v.cloud is not None else v.sighting.points, axis=0) for v in right.views
    ], axis=0)  # fmt: skip
    check_scale(moved(right, lambda points: points - middle), "mm")
    check_scale(moved(right, lambda points: points - points.mean(axis=0)), "mm")


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_another_unit_is_refused(right, factor):
    with pytest.raises(InputError, match="the scale looks off by 1000"):
        check_scale(moved(right, lambda points: points * factor), "mm")


def test_a_size_that_no_centimetres_explain_is_refused_with_a_unit_that_may(session):
    right = load_session(session)
    with pytest.raises(InputError, match=r'cloud_unit = "cm"; the scale looks off by 100: set cloud_unit = "m"'):
        check_scale(moved(right, lambda points: points * 1e-4), "cm")
    with pytest.raises(InputError, match=r'cloud_unit = "inch"; the scale looks off by 25.4: set cloud_unit = "mm"'):
        check_scale(moved(right, lambda points: points * 1e4), "inch")


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_one_cloud_in_another_unit_is_told_from_a_session_in_another_unit(session, factor):
    """Whichever unit the session states, its advice leads to the one odd cloud and not back."""
    right = load_session(session)
    first, *others = right.views
    odd = replace(first, cloud=replace(first.cloud, points=first.cloud.points * factor))
    mixed = replace(right, views=(*others, odd))
    with pytest.raises(InputError, match=f"view {first.name} .* that cloud alone is in another unit .* in mm$"):
        check_scale(mixed, "mm")
    with pytest.raises(InputError, match='set cloud_unit = "mm"'):
        check_scale(moved(mixed, lambda points: points * 1000), "m")


def test_one_stray_point_is_named(session):
    file = sorted((session / "clouds").iterdir())[1]
    points = read_cloud(file).points
    points[7, 2] = 1e30
    np.savetxt(file.with_suffix(".xyz"), points)
    edit(session / "views.csv", file.name, file.with_suffix(".xyz").name)
    with pytest.raises(InputError, match=r"view v001 .* 1 of \d+ points lie more than 1000 m .* point 8; to fix"):
        load_session(session)


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


def test_nominal_targets_are_left_alone_where_only_the_arm_is_asked_for(tmp_path):
    session = labelled_cell(3, views=5)[0]
    folder = write_labelled(tmp_path / "s", session)
    sighting = session.views[0].sighting
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in zip(sighting.targets, sighting.points, strict=True)]
    (folder / "targets.csv").write_text("\n".join(["target,x,y,z", *rows]) + "\n")
    assert load_session(folder).nominal.targets == sighting.targets
    assert load_session(folder, scans=False).nominal is None


def any_table(header, rows):
    def cell(text):
        return '"' + text.replace('"', '""') + '"'

    return "\n".join([",".join(header), *(",".join(cell(c) for c in row) for row in rows)])


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "csv"])
@quick
@given(data=st.data())
def test_bytes_that_are_no_cloud_are_refused_in_one_line(tmp_path, suffix, data):
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
def test_any_header_of_a_cloud_is_read_or_refused_in_one_line(tmp_path, count, encoding, body, sizes):
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
def test_any_table_is_read_or_refused_in_one_line(tmp_path, rows, width):
    pose = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    readers = {
        "views.csv": (["view", "cloud", *pose], lambda file: read_views(file, None)),
        "points.csv": (["view", "target", *pose], lambda file: read_points(file, ["v0", "v1"])),
        "frames.csv": (["view", "note", *pose], lambda file: read_frames(file, ["v0", "v1"])),
    }
    for name, (header, read) in readers.items():
        (tmp_path / name).write_text(
            any_table(header[: max(width, 5)] if width < 9 else header, rows), encoding="utf-8"
        )
        with read_or_refused():
            read(tmp_path / name)


@quick
@given(text=st.text(max_size=200), value=JSON, key=st.sampled_from(["name", "scanner", "robot", "part", "sphere"]))
def test_any_session_toml_is_read_or_refused_in_one_line(tmp_path, text, value, key):
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
def test_any_result_of_a_run_is_read_or_refused_in_one_line(tmp_path, value, key):
    for name, read in (("result.json", read_result), ("ledger.json", read_ledger)):
        for told in (value, {key: value}, [{key: value}]):
            (tmp_path / name).write_text(json.dumps(told))
            with read_or_refused():
                read(tmp_path)


@pytest.fixture
def run(tmp_path):
    """The documents of a run, as far as they say what the folder is."""
    folder = tmp_path / "r"
    folder.mkdir()
    (folder / "model.toml").write_text('format = "stitch-model/1"\n')
    (folder / "result.json").write_text(json.dumps({"format": "stitch-run/1", "session": "/data/blade-17"}))
    (folder / "ledger.json").write_text("[]")
    return folder


def test_a_run_is_no_session(run):
    with pytest.raises(InputError, match=r"r: is a run of /data/blade-17, not a session; to fix: name the session$"):
        load_session(run)


def test_the_runs_of_a_rig_are_no_session(run):
    for name in ("a", "b"):
        (run / name).mkdir()
        (run / name / "result.json").write_text(json.dumps({"format": "stitch-run/1", "session": f"/data/{name}"}))
    (run / "result.json").unlink()
    with pytest.raises(InputError, match="is a run of /data/a, /data/b, not a session"):
        load_session(run)


def test_scans_beside_another_result_are_still_to_be_made_a_session(tmp_path):
    (tmp_path / "result.json").write_text('{"ok": true}')
    with pytest.raises(InputError, match="session.toml: not found; .* `stitch init"):
        load_session(tmp_path)


def test_no_folder_says_what_to_name(tmp_path):
    with pytest.raises(InputError, match=r"to fix: name a folder that exists, .*nosuch does not$"):
        load_session(tmp_path / "nosuch")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"to fix: name a folder, .*file is a file$"):
        load_session(tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "read"), [("model.toml", read_model), ("result.json", read_result), ("ledger.json", read_ledger)]
)
def test_a_run_that_has_lost_a_file_is_damaged(run, name, read):
    (run / name).unlink()
    with pytest.raises(InputError, match=f"r: damaged, its {name} is missing; to fix: `stitch run`"):
        read(run)


def test_a_folder_that_is_no_run_is_not_called_damaged(tmp_path):
    with pytest.raises(InputError, match="model.toml: not found; name a run folder"):
        read_model(tmp_path)


def test_what_may_not_be_read_says_so(session, monkeypatch):
    """Rights do not bind the user who tests this everywhere; the refusal of the system is acted."""
    opened = Path.open

    def refused(self, *arguments, **more):
        if self.name in ("v001.ply", "locked.toml"):
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return opened(self, *arguments, **more)

    (session / "locked.toml").write_text("")
    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InputError, match=r"view v001 .*v001.ply: may not be read; to fix: change its rights"):
        load_session(session)
    with pytest.raises(InputError, match=r"locked.toml: may not be read; to fix: change its rights"):
        read_text(session / "locked.toml", "write it")


@pytest.mark.parametrize("name", ["..", ".", "../x", "/abs", "a/b", "a\\b", "", " ", ".hidden", " a", "µ" * 150])
def test_names_that_cannot_name_a_folder_are_refused(name):
    with pytest.raises(InputError, match=r"session.toml: name .*; to fix: "):
        require_folder_name("session.toml", name)


@pytest.mark.parametrize("name", ["a\0b", "a\nb", "\x1b[31m", "x" * 201])
def test_names_that_nobody_can_print_are_refused(name):
    with pytest.raises(InputError) as error:
        require_name("views.csv line 3", name, "view")
    assert str(error.value).isprintable() and len(str(error.value)) < 250


@pytest.mark.parametrize(
    "name", ["blade-17", "Größe µ", "[red]x[red]", ":smile:", "O'Brien & Söhne", "a..b", "x" * 200]
)
def test_odd_names_stay_as_they_are(name):
    assert require_folder_name("session.toml", name) == name


def test_a_session_without_a_name_has_that_of_its_folder(session, monkeypatch):
    file = session / "session.toml"
    file.write_text(file.read_text().replace('name = "s"\n', ""))
    monkeypatch.chdir(session)
    assert load_session(".").name == session.name

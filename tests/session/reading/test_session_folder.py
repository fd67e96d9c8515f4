"""Sessions: what is read, and the one line that every bad input gets."""

import numpy as np
import pytest

from data_synth.fixtures.edits import edit, set_cell
from stitch.cli.main import main
from stitch.errors import InputError
from stitch.session.reading.session_folder import load_session


def test_good_session(session):
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
def test_bad_input_is_one_line_exit_2_and_leaves_nothing(session, tmp_path, capsys, name):
    spoil, expected = BAD[name]
    spoil(session)
    with pytest.raises(InputError) as error:
        load_session(session)
    assert "\n" not in str(error.value)
    for piece in expected:
        assert piece in str(error.value), str(error.value)
    with pytest.raises(SystemExit) as ended:
        main(["run", str(session), "-o", str(tmp_path / "out" / "run")])
    assert ended.value.code == 2
    assert not (tmp_path / "out").exists()
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.strip() == f"stitch: {error.value}"


def test_real_sessions_are_read(shared_data):
    for name, views in (("reghec/david", 9), ("fanuc-line-sphere", 15), ("irb120-tracker", 600), ("ur10-tmac", 1495)):
        assert len(load_session(shared_data / name).views) == views

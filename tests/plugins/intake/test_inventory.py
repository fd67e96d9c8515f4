"""Every list of numbers in a folder is found, and the one that serves the clouds is taken for the poses.

A tool or a base that changed at one view is named with its size, where the poses fit with it undone.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.intake import sudden_change
from stitch.plugins.intake.cloud_pairs import Pairing
from stitch.plugins.intake.convention_choice import ConventionScore, Interpretation
from stitch.plugins.intake.first_session import capture_of
from stitch.plugins.intake.folder_files import find_folder_files
from stitch.plugins.intake.layouts import MM, possible_layouts
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import readings
from stitch.plugins.intake.sudden_change import require_no_change
from stitch.screening.closing import surface_misfit
from stitch.screening.motions import TRANSLATION_M, RelativeScans, fit_motions
from stitch.session.session import Cloud

R = Rotation.random(5, np.random.default_rng(1))
P = np.random.default_rng(2).uniform(300, 800, (5, 3))
TABLE = np.hstack([P, R.as_quat()])
X = frames.make(Rotation.from_rotvec([0.08, -0.12, 0.75]).as_matrix(), np.array([62.0, -38.0, 95.0]))
CLOUDS = [Path(f"cell/scan_{i:02d}.ply") for i in range(10)]


@pytest.fixture
def scans(tmp_path):
    """A folder with five clouds."""
    for i in range(5):
        (tmp_path / f"scan_{i}.ply").write_bytes(b"ply\n")
    return tmp_path


def matrices():
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), P
    return T.tolist()


def test_a_camera_description_beside_a_list_of_frames_is_no_pose(scans):
    lens = {"fl_x": 500.0, "fl_y": 500.0, "cx": 320.0, "cy": 240.0, "k1": 0.0, "k2": 0.0}
    frames = [{"file_path": f"images/scan_{i}.png", "transform_matrix": T} for i, T in enumerate(matrices())]
    (scans / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    found = find_folder_files(scans)
    assert np.allclose(found.raw.numbers.reshape(5, 4, 4), matrices())
    assert found.raw.part == "frames" and found.raw.labels[3] == ("images/scan_3.png",)


@pytest.mark.parametrize("beside", ["temperature,21.5\nexposure,8500\n\nlens,\nfx,386.1\n", "only words\n"])
def test_descriptions_named_like_the_clouds_are_left_aside(scans, beside):
    for i in range(5):
        (scans / f"scan_{i}_metadata.csv").write_text(beside)
    np.savetxt(scans / "table.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    found = find_folder_files(scans)
    assert [file.name for file in found.poses] == ["table.csv"]
    (aside,) = [entry for entry in found.inventory if not entry.taken_for]
    assert len(aside.files) == 5 and aside.why_not


def test_one_list_of_a_file_is_named_behind_its_name(scans):
    rows = [{"marker": T, "robot": T} for T in matrices()]
    (scans / "both.json").write_text(json.dumps(rows))
    assert find_folder_files(scans).raw.part == "robot"
    assert find_folder_files(scans, scans / "both.json#marker").raw.part == "marker"
    with pytest.raises(InputError, match="both.json#marker, both.json#robot"):
        find_folder_files(scans, scans / "both.json#table")


def test_a_refusal_shows_what_stands_in_the_folder(scans):
    (scans / "lens.json").write_text(json.dumps({"fx": 1.0, "fy": 1.0, "cx": 0.5, "cy": 0.5, "k1": 0.1}))
    (scans / "notes.txt").write_text("the robot was warm\n")
    (scans / "temperatures.csv").write_text("a,b\n" + "1,2\n" * 5)
    with pytest.raises(InputError, match="no list of poses there") as refused:
        find_folder_files(scans)
    text = str(refused.value)
    assert "lens.json: 1 row of 5 numbers (fx, fy, cx, cy, k1)" in text and "temperatures.csv: 5 rows of 2" in text
    assert "--poses FILE#LIST" in text and "--columns" in text


def test_texts_of_other_things_do_not_stop_it(scans):
    (scans / "drawing.svg").write_text(f'<svg><path d="{"0.5,0.25 " * 30000}"/></svg>')
    (scans / "quoted.txt").write_text(f'"{"a,b " * 60000}"\nx,y\n1,2\n')
    (scans / "broken.xml").write_text("<a><b>")
    (scans / "broken.yaml").write_text("a: [1,2\n b: }")
    (scans / "blank.txt").write_text("\n")
    np.savetxt(scans / "a.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    found = find_folder_files(scans)
    assert [file.name for file in found.poses] == ["a.csv"] and len(found.inventory) == 6


def test_a_text_of_another_ending_is_opened(scans):
    lines = [f'<Rob><RIst X="{x}" Y="{y}" Z="{z}" A="10" B="20" C="{30 + x}"/></Rob>' for x, y, z in P.tolist()]
    (scans / "log.rsi").write_text("\n".join(lines))
    found = find_folder_files(scans)
    assert found.raw.part == "RIst" and np.allclose(found.raw.numbers[:, :3], P)


def test_its_own_files_are_passed_over_and_another_points_csv_is_not(scans):
    np.savetxt(scans / "points.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    (scans / "session.toml").write_text('format = "stitch-session/1"\n')
    (scans / "views.csv").write_text("view,cloud,x,y,z,qx,qy,qz,qw\na,scan_0.ply,0,0,0,0,0,0,1\n")
    assert [file.name for file in find_folder_files(scans).poses] == ["points.csv"]


def test_rows_that_are_all_alike_and_columns_of_other_names_are_no_poses(scans):
    (scans / "links.json").write_text(json.dumps([dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 0.0)] * 5))
    lens = [dict.fromkeys(("fx", "fy", "cx", "cy", "k1"), 1.0) | {"k2": i / 10} for i in range(5)]
    (scans / "robot.json").write_text(json.dumps(lens))
    np.savetxt(scans / "a.csv", TABLE, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    found = find_folder_files(scans)
    assert [file.name for file in found.poses] == ["a.csv"]
    reasons = {entry.files[0].name: entry.why_not for entry in found.inventory}
    assert reasons["links.json"] == "all its rows are alike"


def scanned(T, cylinder=False):
    """Scans of a lumpy body, or of a cylinder about x, from poses (V, 4, 4) of the scanner."""
    random = np.random.default_rng(6)
    outwards = random.normal(size=(8_000, 3)) * ([0, 1, 1] if cylinder else 1)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    x, y, z = outwards.T
    body = (
        60 * outwards if cylinder else outwards * (60 + 9 * np.sin(3 * x + 1) + 8 * np.cos(4 * y) + 7 * x * z)[:, None]
    )
    body = body + random.uniform(-80, 80, (8_000, 1)) * [cylinder, 0, 0]
    seen = [body[(pose[:3, 3] * outwards).sum(axis=1) > 120] for pose in T]
    return capture_of([Cloud(frames.transform(frames.inverse(P), p)) for P, p in zip(T, seen, strict=True)], 1.0)


def campaign(tool=None, base=None, views=slice(5, None), slid=None):
    """Scans of ten poses, the motions between them, exact or slid from the sixth on, ways to read the poses, changed at
    some, and the best of them as it stands."""
    random = np.random.default_rng(5)
    away = random.normal((0.0, 0.0, 1.0), 0.25, size=(10, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    R = [Rotation.align_vectors([-a], [[0, 0, 1]])[0] * Rotation.from_rotvec([0, 0, i]) for i, a in enumerate(away)]
    poses = frames.make(np.array([r.as_matrix() for r in R]), 350 * away)
    capture = scanned(poses, cylinder=slid is not None)
    T = poses @ frames.inverse(X)
    if slid is not None:
        poses[5:] = slid @ poses[5:]
    pairs = [(v, v + step) for step in (1, 2) for v in range(10 - step)]
    motions = np.array([frames.inverse(poses[v]) @ poses[w] for v, w in pairs])
    written = T.copy()
    written[views] = (np.eye(4) if base is None else base) @ T[views] @ (np.eye(4) if tool is None else tool)
    raw = RawPoses("poses", None, written.reshape(-1, 16), ((),) * 10, "")
    (layout,) = possible_layouts(raw)
    pairing = Pairing(tuple(range(10)), "", True)
    ways = [Interpretation(readings(layout)[0], pairing, "mm", carries) for carries in (True, False)]
    fit = surface_misfit(capture, ways[0].hypothesis(0), [X])
    best = ConventionScore(ways[0], fit.T_mount, fit.misfit, fit.meets, None)
    return (capture, range(10), RelativeScans(tuple(pairs), motions)), ways, best


def test_each_group_is_stated_with_its_rows_where_a_cloud_shows_nothing():
    """The clouds are eleven, of which the first is empty, and the rows begin with its own."""
    change = frames.make(np.eye(3), np.array([0.0, 0.0, 150.0]))
    (capture, _, motions), ways, best = campaign(tool=change)
    ways = [replace(way, pairing=Pairing(tuple(range(1, 11)), "", True)) for way in ways]
    for way in ways:
        object.__setattr__(way.reading, "T", np.concatenate([np.eye(4)[None], way.reading.T]))
    with pytest.raises(InputError) as refused:
        require_no_change([Path("cell/empty.ply"), *CLOUDS], (capture, range(1, 11), motions), ways, best)
    assert [fix.options["rows"] for fix in refused.value.fixes] == ["-,2,3,4,5,6,-,-,-,-,-", "-,-,-,-,-,-,7,8,9,10,11"]


def test_poses_without_a_change_are_let_through():
    require_no_change(CLOUDS, *campaign())


def test_scans_of_a_cylinder_that_register_slid_and_turned_on_it_show_no_change():
    """With a change of the base undone all motions close; the scans lie on each other as well without."""
    slid = frames.make(Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix(), np.array([25.0, 0.0, 0.0]))
    require_no_change(CLOUDS, *campaign(slid=slid))


@pytest.mark.parametrize("side", ["tool", "base"])
def test_a_change_is_named_with_its_view_and_its_size(side):
    change = frames.make(np.eye(3), np.array([0.0, 0.0, 150.0]))
    with pytest.raises(InputError, match="changed at scan_05.ply") as refused:
        require_no_change(CLOUDS, *campaign(**{side: change}))
    assert "150.0) mm and 0.00°" in str(refused.value) and "100% of the scanner's motions close" in str(refused.value)


def test_of_the_first_few_views_the_others_changed():
    """Which half is smaller is chance: what is named is the view at which it changed."""
    base = frames.make(np.eye(3), np.array([0.0, 30.0, 150.0]))
    (_, _, motions), ways, _ = campaign(base=base, views=slice(0, 4))
    fit = fit_motions(ways[0].hypothesis(0), motions, TRANSLATION_M / MM)
    halves = [later for later in sudden_change._groups(fit, motions) if later[:4].all() != later[4:].all()]
    assert halves and not any(later[0] for later in halves)


@pytest.mark.parametrize(
    ("side", "views"),
    [
        ("tool", slice(1, None, 2)),
        ("base", [1, 3, 6, 8]),
        pytest.param("base", slice(1, None, 2), marks=pytest.mark.slow),
    ],
)
def test_two_lists_in_one_table_are_named_with_their_views(side, views):
    change = frames.make(np.eye(3), np.array([0.0, 30.0, 150.0]))
    with pytest.raises(InputError, match="two lists of poses are mixed") as refused:
        require_no_change(CLOUDS, *campaign(**{side: change}, views=views))
    named = {cloud.name for cloud in CLOUDS if cloud.name in str(refused.value)}
    changed = {CLOUDS[i].name for i in np.arange(10)[views]}
    assert named in (changed, {cloud.name for cloud in CLOUDS} - changed)
    assert "30.0, 150.0) mm" in str(refused.value).replace("-", "") and "100% of" in str(refused.value)

"""A tool or a base that changed at one view is named with its size, where the poses fit with it undone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.intake import sudden_change
from stitch.plugins.intake.cloud_pairs import Pairing
from stitch.plugins.intake.convention_choice import Interpretation
from stitch.plugins.intake.layouts import MM, possible_layouts
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import readings
from stitch.plugins.intake.sudden_change import require_no_change
from stitch.screening.motions import TRANSLATION_M, RelativeScans, fit_motions

X = frames.make(Rotation.from_rotvec([0.08, -0.12, 0.75]).as_matrix(), np.array([62.0, -38.0, 95.0]))
CLOUDS = [Path(f"cell/scan_{i:02d}.ply") for i in range(10)]


def campaign(tool=None, base=None, views=slice(5, None)):
    """Ways to read ten poses, changed at some of them, and the exact motions of the scans."""
    random = np.random.default_rng(5)
    T = frames.make(Rotation.random(10, random).as_matrix(), random.uniform(-400, 400, (10, 3)))
    pairs = [(v, v + step) for step in (1, 2) for v in range(10 - step)]
    motions = np.array([frames.inverse(T[v] @ X) @ T[w] @ X for v, w in pairs])
    written = T.copy()
    written[views] = (np.eye(4) if base is None else base) @ T[views] @ (np.eye(4) if tool is None else tool)
    raw = RawPoses("poses", None, written.reshape(-1, 16), ((),) * 10, "")
    (layout,) = possible_layouts(raw)
    pairing = Pairing(tuple(range(10)), "", True)
    ways = [Interpretation(readings(layout)[0], pairing, "mm", carries) for carries in (True, False)]
    return RelativeScans(tuple(pairs), motions), ways


def test_each_group_is_stated_with_its_rows_where_a_cloud_shows_nothing():
    """The clouds are eleven, of which the first is empty, and the rows begin with its own."""
    change = frames.make(np.eye(3), np.array([0.0, 0.0, 150.0]))
    motions, ways = campaign(tool=change)
    ways = [replace(way, pairing=Pairing(tuple(range(1, 11)), "", True)) for way in ways]
    for way in ways:
        object.__setattr__(way.reading, "T", np.concatenate([np.eye(4)[None], way.reading.T]))
    with pytest.raises(InputError) as refused:
        require_no_change([Path("cell/empty.ply"), *CLOUDS], motions, ways, range(1, 11))
    assert [fix.options["rows"] for fix in refused.value.fixes] == ["-,2,3,4,5,6,-,-,-,-,-", "-,-,-,-,-,-,7,8,9,10,11"]


def test_poses_without_a_change_are_let_through():
    require_no_change(CLOUDS, *campaign(), range(10))


@pytest.mark.parametrize("side", ["tool", "base"])
def test_a_change_is_named_with_its_view_and_its_size(side):
    change = frames.make(np.eye(3), np.array([0.0, 0.0, 150.0]))
    with pytest.raises(InputError, match="changed at scan_05.ply") as refused:
        require_no_change(CLOUDS, *campaign(**{side: change}), range(10))
    assert "150.0) mm and 0.00°" in str(refused.value) and "100% of the scanner's motions close" in str(refused.value)


def test_of_the_first_few_views_the_others_changed():
    """Which half is smaller is chance: what is named is the view at which it changed."""
    motions, ways = campaign(base=frames.make(np.eye(3), np.array([0.0, 30.0, 150.0])), views=slice(0, 4))
    fit = fit_motions(ways[0].hypothesis(0), motions, TRANSLATION_M / MM)
    halves = [later for later in sudden_change._groups(fit, motions) if later[:4].all() != later[4:].all()]
    assert halves and not any(later[0] for later in halves)


@pytest.mark.parametrize(
    ("side", "views"), [("tool", slice(1, None, 2)), ("base", slice(1, None, 2)), ("base", [1, 3, 6, 8])]
)
def test_two_lists_in_one_table_are_named_with_their_views(side, views):
    change = frames.make(np.eye(3), np.array([0.0, 30.0, 150.0]))
    with pytest.raises(InputError, match="two lists of poses are mixed") as refused:
        require_no_change(CLOUDS, *campaign(**{side: change}, views=views), range(10))
    named = {cloud.name for cloud in CLOUDS if cloud.name in str(refused.value)}
    changed = {CLOUDS[i].name for i in np.arange(10)[views]}
    assert named in (changed, {cloud.name for cloud in CLOUDS} - changed)
    assert "30.0, 150.0) mm" in str(refused.value).replace("-", "") and "100% of" in str(refused.value)

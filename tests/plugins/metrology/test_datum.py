"""Numbers in the frame of a datum, against a part that lies elsewhere and against runs whose views err."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.shapes.spheres import SpherePlate, centres
from stitch.api.pipeline import run
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.plugins.metrology.budget import OWN_NOISE, measure_features, monte_carlo
from stitch.plugins.metrology.datum import into_datum
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList, read_features
from stitch.plugins.metrology.features import Feature

PLATE = SpherePlate(radius=28.0)
DATUM = ("ball 0.x", "ball 0.y", "ball 0.z", "ball 1.y", "ball 1.z", "ball 2.z")


@pytest.fixture(scope="module")
def cell():
    """Where the points of a sphere plate are, and four balls with a distance; three of the balls are its datum."""
    scene = clean("spheres", rays=90, noise=0.02)
    part = replace(scene.part, labelled=False, parameters={"radius": PLATE.radius})
    scene = replace(scene, part=part, repeatability=(15e-6, 0.01))
    balls = frames.transform(scene.T_reference_part, centres(PLATE))
    # Along x, across it, and above: the three of the datum first.
    order = [0, *np.argsort(-np.abs(balls - balls[0])[:, 0])[:1], *np.argsort(-np.abs(balls - balls[0])[:, 1])]
    first = list(dict.fromkeys(order))[:4]
    wanted = [Feature(f"ball {i}", "sphere", at=balls[k], size=56.0, within=3.0) for i, k in enumerate(first)]
    wanted.append(Feature("apart", "distance", between=("ball 0", "ball 3")))
    places = place_errors(run(session_of(simulated(scene, {}, 3, views=6))))
    return places, FeatureList(tuple(wanted), datum=DATUM)


def measured_in_datum(places, wanted):
    places, T = into_datum(places, wanted)
    return measure_features(places, wanted), T, places


def values(measured):
    return np.array([number.value for number in measured.numbers])


def test_the_numbers_of_the_datum_are_nominal_and_have_no_U(cell):
    measured, T, _ = measured_in_datum(*cell)
    of_datum = [n for n in measured.numbers if n.name in DATUM]
    assert max(abs(n.value - n.nominal) for n in of_datum) < 1e-6
    assert max(n.U for n in of_datum) == 0.0
    assert frames.is_rigid(T) and not np.allclose(T, np.eye(4))


def test_sizes_and_distances_are_as_without_a_datum(cell):
    places, wanted = cell
    measured, _, _ = measured_in_datum(places, wanted)
    free = measure_features(places, replace(wanted, datum=()))
    for number, alone in zip(measured.numbers, free.numbers, strict=True):
        if number.quantity in ("diameter", "distance"):
            assert number.value == pytest.approx(alone.value, abs=2e-4)
            assert number.u / alone.u == pytest.approx(1, rel=1e-3)


def test_where_the_part_lies_does_not_count(cell):
    places, wanted = cell
    there = frames.moved_about(places.centre, np.array([4e-3, -2e-3, 3e-3, 0.5, -0.7, 0.4]), np.eye(4))
    elsewhere = replace(places, poses=there @ places.poses, centre=frames.transform(there, places.centre[None])[0])
    measured, T, _ = measured_in_datum(places, wanted)
    again, T_again, _ = measured_in_datum(elsewhere, wanted)
    assert values(again) == pytest.approx(values(measured), abs=2e-4)
    assert T_again @ there == pytest.approx(T, abs=1e-3)


def test_numbers_answer_to_views_that_err_as_the_propagation_says(cell):
    places, wanted = cell
    sources = tuple(s for s in places.sources if s.views.any() and not s.shapes.any())
    places = replace(places, sources=sources)
    measured, _, _ = measured_in_datum(places, wanted)
    rng = np.random.default_rng(4)
    drawn = []
    for _ in range(60):
        twists = sum(s.views @ rng.standard_normal(s.views.shape[1]) for s in sources).reshape(-1, 6)
        moved = frames.moved_about(places.centre, twists, np.eye(4))
        drawn.append(values(measured_in_datum(replace(places, poses=moved @ places.poses), wanted)[0]))
    spread = np.std(drawn, axis=0, ddof=1)
    for number, found in zip(measured.numbers, spread, strict=True):
        share = 1 - number.shares[OWN_NOISE]
        if number.name not in DATUM and share > 0.05:
            # Five standard deviations of 60 draws, in which points have no noise.
            assert 1 - 5 / np.sqrt(120) < found / (number.u * np.sqrt(share)) < 1 + 5 / np.sqrt(120)


def test_trials_agree(cell):
    measured, _, places = measured_in_datum(*cell)
    found = monte_carlo(places, cell[1], measured.fits, 400)
    free = [k for k, n in enumerate(measured.numbers) if n.name not in DATUM]
    assert np.abs(found.ratio[free] - 1).max() < 5 / np.sqrt(2 * 400)
    assert measured.numbers[free[0]].shares[OWN_NOISE] > 0


def test_six_numbers_that_leave_a_motion_open_are_refused(cell):
    places, wanted = cell
    with pytest.raises(NoResultError, match=r"datum: its six numbers leave a motion of the part open; to fix"):
        into_datum(places, replace(wanted, datum=(*DATUM[:5], "ball 1.x")))


@pytest.mark.parametrize("datum", ['["top.offset"]', '"top"', str([*["top.offset"] * 6]).replace("'", '"'), "[1, 2]"])
def test_a_datum_of_other_numbers_is_refused_in_one_line(tmp_path, datum):
    file = tmp_path / "features.toml"
    file.write_text(
        f'datum = {datum}\n[[feature]]\nname = "top"\nkind = "plane"\nat = [0, 0, 0]\nnormal = [0, 0, 1]\nradius = 9\n'
    )
    with pytest.raises(InputError, match="datum is .*; to fix: name six numbers"):
        read_features(file, "mm", 0.5)

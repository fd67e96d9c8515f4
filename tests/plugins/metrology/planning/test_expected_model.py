"""What planned views would show, and how well they would tell the hand-eye."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.ideal_scanner import facing
from data_synth.fixtures.in_memory import session_of
from stitch.diagnosis.candidates import candidates_of
from stitch.errors import InputError, NoResultError
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.plugins.metrology.planning.detection_chances import ExpectedDiagnosis
from stitch.plugins.metrology.planning.expected_model import (
    CellModel,
    FieldOfView,
    Scatter,
    block_surface,
    expected_hand_eye,
    expected_model,
    expected_scan,
    simulate_views,
    surface_of_file,
    surface_of_mesh,
)

WIDE = FieldOfView(np.array([2.0, 2.0]), 1.0, 1e4, standoff=500.0, axis=np.array([0.0, 0.0, 1.0]))


def test_of_a_sphere_it_sees_the_cap_that_faces_it():
    """A ray meets the sphere at 75° where sin φ = R sin 75° / D; the cap up to there is (1 − cos(75° − φ))/2 of it."""
    radius, distance, limit = 100.0, 400.0, np.radians(75.0)
    sphere = surface_of_mesh(trimesh.creation.icosphere(subdivisions=5, radius=radius))
    seen = len(expected_scan(sphere, facing(distance), WIDE)) / len(sphere.points)
    cap = (1 - np.cos(limit - np.arcsin(radius * np.sin(limit) / distance))) / 2
    assert seen == pytest.approx(cap, abs=4 * np.sqrt(cap * (1 - cap) / len(sphere.points)))


def test_a_tower_hides_what_lies_behind_it():
    """Seen from 500 mm above, a tower of 60 × 60 × 150 mm shades 30·500/350 = 43 mm of the floor to each side."""
    floor = trimesh.creation.box([300.0, 300.0, 1.0])
    tower = trimesh.creation.box([60.0, 60.0, 150.0])
    tower.apply_translation([0, 0, 75.0])
    part = surface_of_mesh(trimesh.util.concatenate([floor, tower]))
    seen = part.points[expected_scan(part, facing(500.0), WIDE)]
    on_floor = np.abs(seen[seen[:, 2] < 1.0][:, :2]).max(axis=1)
    # Rays are as wide as two distances between points: 6 mm.
    assert (on_floor < 37).mean() < 0.02
    assert ((on_floor > 49) & (on_floor < 60)).any()
    assert (np.abs(seen[seen[:, 2] > 149.0][:, :2]) <= 30).all()


def test_beyond_its_field_and_reach_it_sees_nothing():
    part = block_surface(200.0)
    narrow = FieldOfView(np.array([0.1, 0.1]), 400.0, 600.0, standoff=500.0, axis=np.array([0.0, 0.0, 1.0]))
    seen = part.points[expected_scan(part, facing(500.0), narrow)]
    assert len(seen) and (np.abs(seen[:, :2]) <= 0.1 * (500.0 - seen[:, 2:])).all()
    assert not len(expected_scan(part, facing(800.0), narrow))
    assert not len(expected_scan(part, facing(-500.0), WIDE))


def test_a_part_is_read_in_its_unit_or_refused(tmp_path):
    trimesh.creation.box([0.2, 0.1, 0.1]).export(tmp_path / "m.stl")
    assert np.ptp(surface_of_file(tmp_path / "m.stl", 1e3).points, axis=0) == pytest.approx([200, 100, 100], rel=1e-3)
    (tmp_path / "p.xyz").write_text("0 0 1\n0 1 1\n1 0 1\n")
    with pytest.raises(InputError, match=r"p\.xyz.*no normals.*to fix"):
        surface_of_file(tmp_path / "p.xyz", 1.0)
    (tmp_path / "b.stl").write_text("no mesh")
    with pytest.raises(InputError, match=r"b\.stl"):
        surface_of_file(tmp_path / "b.stl", 1.0)


ROTATION, TRANSLATION = 5e-5, 0.03
DRAWS = 40


def cell_seeing(measured, near, far):
    """A blade's cell by a scanner that sees between two distances, in standoffs."""
    reach = measured.scene.scanner.standoff
    field = FieldOfView(np.array([0.3, 0.3]), near * reach, far * reach, standoff=reach, axis=np.array([0.0, 0, 1.0]))
    part = surface_of_mesh(measured.mesh.copy()).moved(measured.scene.T_reference_part)
    return CellModel(Model(measured.T_mount), part, field, Scatter(ROTATION, TRANSLATION, 1e-5, 1.0, {}))


@pytest.fixture(scope="module", params=["eye_to_hand", "eye_in_hand"])
def planned(request):
    """What a blade's cell measured, and its views as planned, with a scanner that has next to no noise."""
    measured = measured_blade(3, views=7, mount=request.param, pixels=8)
    cell = cell_seeing(measured, 0.6, 1.4)
    found = simulate_views(session_of(measured), cell)
    return measured, found, expected_model(found, cell)


def _matrix(x):
    return frames.make(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:])


def _six(T, scale):
    turns = Rotation.from_matrix(T[..., :3, :3]).as_rotvec()
    return (np.concatenate([turns, T[..., :3, 3]], axis=-1) / scale).ravel()


def test_the_stated_covariance_is_that_of_fits(planned):
    """χ² of the errors of fits of hand-eye and part to scattered flanges, 99.9 % interval."""
    measured, found, linear = planned
    stated = expected_hand_eye(linear, found).covariance
    scale = np.repeat([ROTATION, TRANSLATION], 3)
    M, reported, rng = measured.T_mount, measured.T_base_flange, np.random.default_rng(5)
    in_hand = measured.scene.mount == "eye_in_hand"
    squares = 0.0
    for _ in range(DRAWS):
        true = reported @ np.array([_matrix(row) for row in rng.standard_normal((len(reported), 6)) * scale])
        part = (true if in_hand else np.linalg.inv(true)) @ M  # scans on the part, wherever that is

        def off(x, part=part):
            """Flanges where hand-eye and part put them, seen from the reported ones."""
            placed = _matrix(x[6:]) @ part @ np.linalg.inv(M @ _matrix(x[:6]))
            flange = placed if in_hand else np.linalg.inv(placed)
            return _six(np.linalg.inv(reported) @ flange, scale)

        x = least_squares(off, np.zeros(12), x_scale=np.tile(scale, 2) * 10, method="lm").x[:6]
        squares += x @ np.linalg.solve(stated, x)
    assert chi2.ppf(5e-4, 6 * DRAWS) < squares < chi2.ppf(1 - 5e-4, 6 * DRAWS)


def test_twice_the_scatter_is_twice_the_uncertainty(planned):
    _, found, linear = planned
    once = expected_hand_eye(linear, found)
    twice = expected_hand_eye(linear.at(linear.null.variances * 4), found)
    assert sum(once.shares.values()) == pytest.approx(1)
    np.testing.assert_allclose(twice.U, 2 * once.U, rtol=0.02)


def test_chances_of_nothing_and_of_what_nobody_can_miss(planned):
    """Nothing is detected about as seldom as the family-wise error says (5 %); a huge backlash always, by its name."""
    measured, _, linear = planned
    if measured.scene.mount == "eye_in_hand":
        pytest.skip("one mount is enough")
    candidates = candidates_of(linear, empirical=False)[0]
    expected, rng = ExpectedDiagnosis(linear, candidates), np.random.default_rng(0)
    nothing = expected.chance("backlash", np.zeros((linear.mixed.size, 200)), rng)
    assert nothing.detected <= 0.11  # 99.9 % of draws at 5 %
    own = next(c for c in candidates if c.name == "backlash")
    column = own.forms[0].columns @ (30 * own.forms[0].sizes)
    huge = expected.chance("backlash", np.repeat(column[:, None], 50, axis=1), rng)
    assert huge.detected == 1.0 and huge.named > 0.9 and huge.misnamed == 0.0


def test_views_that_see_nothing_are_refused(planned):
    measured, *_ = planned
    with pytest.raises(NoResultError, match=r"view v000 would see next to nothing"):
        simulate_views(replace(session_of(measured), name="blind"), cell_seeing(measured, 3.0, 4.0))

"""What a scanner would see of a surface: closed forms of a sphere and of a shadow."""

import numpy as np
import pytest
import trimesh

from data_synth.fixtures.ideal_scanner import facing
from stitch.errors import InputError
from stitch.plugins.metrology.planning.expected_model import (
    FieldOfView,
    block_surface,
    expected_scan,
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

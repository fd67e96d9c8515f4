"""Scanned, stitched and fitted: meshes of real objects, watertight and with holes."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh

from data_synth.scene import load_scene
from data_synth.simulate import simulate
from data_synth.write import write_session
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.plugins.cells.cad import read_cad
from stitch.plugins.cells.placed_scans import join_scans
from stitch.plugins.cells.scan_to_cad import fit_cad
from stitch.session.reading.session_folder import load_session

# Longest side of the scanned object, mm.
SIZE = 200.0


def bunny():
    """The Stanford bunny as pymeshfix brings it: 100,000 triangles with holes in its base."""
    found = find_spec("pymeshfix")
    if found is None:
        pytest.skip("pymeshfix, which brings the mesh, is not installed: pip install 'stitch[dev]'")
    return trimesh.load_mesh(Path(found.origin).parent / "examples" / "StanfordBunny.ply")


def closed_bunny(_):
    import pymeshfix

    broken = bunny()
    repaired = pymeshfix.MeshFix(np.array(broken.vertices), np.array(broken.faces, np.int32))
    repaired.repair()
    return trimesh.Trimesh(repaired.points, repaired.faces)


def broken_bunny(_):
    """Every tenth triangle is missing, three in a thousand lie twice, as exporters leave them."""
    mesh, rng = bunny(), np.random.default_rng(0)
    kept = mesh.faces[rng.random(len(mesh.faces)) > 0.1]
    return trimesh.Trimesh(mesh.vertices, np.concatenate([kept, kept[rng.random(len(kept)) < 0.003]]), process=False)


def turbine_blade(request):
    return trimesh.load_mesh(request.getfixturevalue("shared_data") / "meshes" / "turbineblade.ply")


@pytest.mark.parametrize(
    ("load", "closed"),
    [
        (broken_bunny, False),
        *(pytest.param(load, True, marks=pytest.mark.slow) for load in (closed_bunny, turbine_blade)),
    ],
)
def test_a_real_mesh_is_scanned_stitched_and_fitted(load, closed, request, tmp_path):
    mesh = load(request)
    mesh.apply_scale(SIZE / mesh.extents.max())
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    assert mesh.is_watertight == closed
    mesh.export(tmp_path / "part.ply")
    measured = simulate(scene_of(tmp_path / "part.ply"), {}, 2)
    write_session(tmp_path / "s", measured, "s")
    result = run(load_session(tmp_path / "s"))
    # The simulator knows where the scanner sat; the stated covariance has to hold it (χ² of 6, chance 1e-4).
    off = frames.log(frames.inverse(result.T_mount) @ measured.T_mount)
    assert off @ np.linalg.solve(result.mount_covariance, off) < 27.9
    # Points of the stitched cloud lie on the mesh, by a library that neither simulator nor stitching asks.
    T_part_reference = frames.inverse(measured.scene.T_reference_part)
    square = igl.point_mesh_squared_distance(
        frames.transform(T_part_reference, result.fused.points[::7]), np.array(mesh.vertices), np.array(mesh.faces)
    )[0]
    assert np.sqrt(np.median(square)) < 0.1
    # The fit, begun 1° and 5 mm off, says where the part sits.
    true, begun = measured.scene.T_reference_part, frames.exp(np.array([0.012, -0.008, 0.01, 3.0, -3.0, 2.5]))
    scan, cad = join_scans(list(result.measurement.capture.scans), result.poses), read_cad(tmp_path / "part.ply")
    apart = (fit_cad(scan, cad, true @ begun).T_base_part - true)[:3]
    assert np.linalg.norm(mesh.vertices @ apart[:, :3].T + apart[:, 3], axis=1).max() < 0.5


def scene_of(part):
    """The scanner of the table's blade, coarser, with noise alone, about a mesh."""
    scene = load_scene("blade-table")
    scanner = replace(
        scene.scanner,
        columns=110,
        rows=110,
        field_error=0.0,
        mixed_pixels=0.0,
        dropout=0.0,
        quantisation=0.0,
    )
    place = replace(scene.part, shape="", mesh=str(part))
    return replace(scene, scanner=scanner, part=place, small=0.0, plan=replace(scene.plan, views=8))

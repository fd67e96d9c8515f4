"""Small synthetic cells for the tests: few views, few rays, only the disturbances a test asks for."""

from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import trimesh

from data_synth.scene import Scene, load_scene
from data_synth.simulate import Measured, part_mesh, simulate

CLEAN = {"field_error": 0.0, "mixed_pixels": 0.0, "dropout": 0.0, "quantisation": 0.0}


def clean(name: str, rays: int = 60, **scanner: Any) -> Scene:
    """A scene of the project with nothing in it but the scanner's noise."""
    scene = load_scene(name)
    tool = replace(scene.scanner, columns=rays, rows=rays, **(CLEAN | scanner))
    return replace(scene, scanner=tool, small=0.0, repeatability=(0.0, 0.0))


_MESHES: dict[str, trimesh.Trimesh] = {}


def mesh_for(scene: Scene) -> trimesh.Trimesh:
    """The part of a scene, built once for all tests."""
    found = _MESHES.get(repr(scene.part))
    if found is None:
        found = _MESHES[repr(scene.part)] = part_mesh(scene)
    return found


@cache
def mesh_of(name: str) -> trimesh.Trimesh:
    return mesh_for(load_scene(name))


def simulated(scene: Scene, hidden: dict[str, float], seed: int, views: int | None = None) -> Measured:
    """`simulate` with a part that is built once."""
    with patch("data_synth.simulate.part_mesh", mesh_for):
        return simulate(scene, hidden, seed, views)


def with_part(scene: Scene, shape: str, **parameters: Any) -> Scene:
    """The scene with another part in its place."""
    return replace(scene, part=replace(scene.part, shape=shape, parameters=parameters, labelled=False))

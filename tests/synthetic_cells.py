"""Small synthetic cells for the tests: few views, few rays, only the disturbances a test asks for."""

from dataclasses import replace
from functools import cache
from typing import Any

import trimesh

from data_synth.scene import Scene, load_scene
from data_synth.simulate import part_mesh

CLEAN = {"field_error": 0.0, "mixed_pixels": 0.0, "dropout": 0.0, "quantisation": 0.0}


def clean(name: str, rays: int = 60, **scanner: Any) -> Scene:
    """A scene of the project with nothing in it but the scanner's noise."""
    scene = load_scene(name)
    tool = replace(scene.scanner, columns=rays, rows=rays, **(CLEAN | scanner))
    return replace(scene, scanner=tool, small=0.0, repeatability=(0.0, 0.0))


@cache
def mesh_of(name: str) -> trimesh.Trimesh:
    return part_mesh(load_scene(name))

"""A picture of every scene: the part with the scanner where the views are taken. Writes docs/pictures/*.png.

Run: python bench/docs/pictures.py [SCENE …]
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from data_synth import kinematics
from data_synth.picture import render
from data_synth.planning import plan_views
from data_synth.scene import load_scene, names
from data_synth.simulate import part_mesh
from stitch.numerics import frames

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
# Azimuth and elevation of the camera in degrees: where scanners hide least of the part.
CAMERAS = {
    "blade": (75.0, 30.0), "blade-table": (-175.0, 18.0), "car-door": (-118.0, 16.0), "drill-plate": (-50.0, 18.0),
    "line-sweep": (-55.0, 20.0), "panel": (-50.0, 16.0), "spheres": (-60.0, 16.0),
}  # fmt: skip
COLOURS = 96  # enough for shades and a few lines; a third of the bytes


def picture(name: str) -> Path:
    """Planned views, as the controller would drive them."""
    scene = load_scene(name)
    mesh = part_mesh(scene)
    plan, rail = plan_views(scene, mesh, scene.plan.views, np.random.default_rng([0, 1]))
    T = kinematics.flange(scene.arm, plan.joints)
    T[:, 0, 3] += rail
    T_reference_scanner = (frames.inverse(T) if scene.mount == "eye_to_hand" else T) @ scene.T_mount
    if scene.mount == "eye_in_hand":
        # As it lies in the cell; a part on a flange has no up, so that one is shown as it was drawn.
        mesh = mesh.copy().apply_transform(scene.T_reference_part)
    else:
        T_reference_scanner = frames.inverse(scene.T_reference_part) @ T_reference_scanner
    path = FOLDER / f"{name}.png"
    render(mesh, path, *CAMERAS.get(name, (35.0, 20.0)), size=(900, 600), T_part_scanner=T_reference_scanner,
           standoff=scene.scanner.standoff, field_of_view=scene.scanner.field_of_view)  # fmt: skip
    image = Image.open(path).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    image.save(path, optimize=True)
    return path


def main() -> None:
    for name in sys.argv[1:] or names():
        path = picture(name)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

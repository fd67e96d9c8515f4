"""Pictures of parts: right is right, up is up, scanners are drawn."""

import numpy as np
import trimesh
from PIL import Image

from data_synth.picture import render


def test_picture_shows_right_and_up(tmp_path):
    right = trimesh.creation.box((10, 10, 10)).apply_translation((40, 0, 0))
    up = trimesh.creation.box((10, 10, 10)).apply_translation((0, 0, 40))
    path = render([right, up], tmp_path / "p.png", azimuth=-90, elevation=0, size=(120, 90),
                  colours=[(255, 0, 0), (0, 0, 255)])  # fmt: skip
    pixels = np.asarray(Image.open(path)).astype(int)
    assert pixels.shape == (90, 120, 3)
    red = np.argwhere(pixels[..., 0] > pixels[..., 2] + 60).mean(axis=0)
    blue = np.argwhere(pixels[..., 2] > pixels[..., 0] + 60).mean(axis=0)
    # Rows count downwards.
    assert red[1] > blue[1] + 20 and red[0] > blue[0] + 20
    assert (pixels[0, -1] == 255).all()


def test_picture_draws_scanners(tmp_path):
    box = trimesh.creation.box((10, 10, 10))
    looking = np.eye(4)
    looking[:3, 3] = [0, 0, -60]
    plain = np.asarray(Image.open(render(box, tmp_path / "a.png", size=(160, 120)))).astype(int)
    with_scanner = render(box, tmp_path / "b.png", size=(160, 120), T_part_scanner=looking[None])
    pixels = np.asarray(Image.open(with_scanner)).astype(int)
    reddish = [(p[..., 0] > p[..., 1] + 50).sum() for p in (plain, pixels)]
    assert reddish[0] == 0 and reddish[1] > 50

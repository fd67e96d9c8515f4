"""`stitch synth CELL`: the folder is what the cell's command reads, and the command finds what was hidden.

Pictures of parts: right is right, up is up, scanners are drawn.
"""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from data_synth.cells.base_stand import TwoBases
from data_synth.made_cell import CELLS
from data_synth.picture import render
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from stitch.cli.main import main
from stitch.numerics import frames
from stitch.plugins.cells.base_to_base import read_stand, solve_stand
from tests.command_line import ended


def test_drilling_finds_distortion_and_plate(tmp_path):
    assert "Next: stitch" in ended("synth", "drilling", tmp_path / "cell", "--seed", 3).err
    truth = json.loads((tmp_path / "cell.truth.json").read_text())
    found = json.loads(ended("drill", tmp_path / "cell" / "job.toml", "--json").out)
    for effect in found["camera_effects"]:
        assert effect["accepted"]
        assert abs(effect["value"] - truth["hidden"][effect["effect"]]) < 4 * effect["sigma"]
    true = np.array([truth["holes"][d["hole"]]["position"] for d in found["drives"]])
    assert np.linalg.norm([d["position"] for d in found["drives"]] - true, axis=1).max() < 0.5


def test_two_bases_within_their_sigma(tmp_path):
    """Mean χ² of the pose's six errors over 30 stands: 6 ± 4 standard errors."""
    squares = []
    for seed in range(30):
        cell = TwoBases(seed)
        cell.write(tmp_path / "stand.toml")
        fit = solve_stand(read_stand(tmp_path / "stand.toml")).fit
        R = cell.T_base1_base2[:3, :3] @ fit.T_base1_base2[:3, :3].T
        turn = frames.log(frames.make(R, np.zeros(3)))[:3]
        error = np.append(turn, cell.T_base1_base2[:3, 3] - fit.T_base1_base2[:3, 3])
        squares.append(error @ np.linalg.solve(fit.covariance, error))
    assert abs(np.mean(squares) - 6) < 4 * np.sqrt(12 / 30)


def test_another_day_shares_arm_and_hand_eye(small):
    first, second = (simulate(load_scene(small), {}, 5, day=day) for day in (0, 1))
    assert (first.T_mount == second.T_mount).all()
    assert not np.allclose(first.T_base_flange, second.T_base_flange)
    assert not np.allclose(first.covariates["humidity_percent"], second.covariates["humidity_percent"])


def test_cells_are_whole_or_not_there(tmp_path, monkeypatch):
    def fails(folder, seed):
        (folder / "half.csv").write_text("x")
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(CELLS, "drilling", CELLS["drilling"]._replace(write=fails))
    with pytest.raises((OSError, SystemExit)):
        main(["synth", "drilling", str(tmp_path / "cell")])
    assert not list(tmp_path.iterdir())


def test_cells_have_their_own_errors(tmp_path):
    told = ended("synth", "two-bases", tmp_path / "cell", "--hide", "backlash", code=2)
    assert "leave out --hide" in told.err
    assert not (tmp_path / "cell").exists()


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
    looking = frames.make(np.eye(3), np.array([0, 0, -60]))
    plain = np.asarray(Image.open(render(box, tmp_path / "a.png", size=(160, 120)))).astype(int)
    with_scanner = render(box, tmp_path / "b.png", size=(160, 120), T_part_scanner=looking[None])
    pixels = np.asarray(Image.open(with_scanner)).astype(int)
    reddish = [(p[..., 0] > p[..., 1] + 50).sum() for p in (plain, pixels)]
    assert reddish[0] == 0 and reddish[1] > 50

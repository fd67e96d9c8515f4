"""Stations and robot paths of a window cell as the files that `stitch fit` and `stitch seam` read."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_synth.csv_rows import POSE, pose_numbers, write_rows

Array = NDArray[np.float64]


def write_stations(file: Path, middle: Array, across: Array, outwards: Array) -> None:
    """Stations 1 … N in the part frame."""
    places = np.hstack([middle, across, outwards])
    rows = [[i + 1, *np.round(place, 6).tolist()] for i, place in enumerate(places)]
    write_rows(file, "station x y z across_x across_y across_z out_x out_y out_z", rows)


def write_path(file: Path, poses: Array) -> None:
    """A robot path p1 … pN."""
    write_rows(file, f"name {POSE}", [[f"p{i + 1}", *pose_numbers(T, 7)] for i, T in enumerate(poses)])


def pose_table(T: Array) -> str:
    """The lines of a TOML table that hold a pose."""
    return "\n".join(f"{k} = {v}" for k, v in zip(POSE.split(), pose_numbers(T, 7), strict=True))

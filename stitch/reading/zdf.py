"""Zivid's .zdf, by h5py: an HDF5 file as netCDF-4 writes it, in the layout of Zivid's own sample programs.

/data/pointcloud is (H, W, 3), mm, NaN where nothing was measured; /data/rgba_image is (H, W, 4) with 8 bits. Source:
read_zdf_without_zivid.py in github.com/zivid/zivid-python-samples.
"""

from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.reading.extras import import_extra
from stitch.reading.organised import measured_pixels

_COLOURS = ("red", "green", "blue")


def read_zdf(path: Path) -> dict[str, Array]:
    """Columns (N,) of the measured pixels, with their colours.

    Raises:
        InputError: h5py is not installed, or another layout.
    """
    points, colours = read_zdf_image(path)
    columns = dict(zip("xyz", points.reshape(-1, 3).T, strict=True))
    if colours is not None:
        columns |= dict(zip(_COLOURS, colours.reshape(3, -1), strict=True))
    return measured_pixels(columns)


def read_zdf_image(path: Path) -> tuple[Array, Array | None]:
    """Points (H, W, 3) and colours (3, H, W), these where the file has them.

    Raises:
        InputError: h5py is not installed, or another layout.
    """
    with import_extra("h5py", path, "formats").File(path, "r") as file:
        told = file.get("data/pointcloud")
        if told is None or len(told.shape) != 3 or told.shape[2] != 3:
            raise InputError(f"{path}: no data/pointcloud of x, y, z in it; to fix: save it as PLY in Zivid Studio")
        points, image = np.asarray(told, float), file.get("data/rgba_image")
        if image is None or image.shape[:2] != points.shape[:2] or image.shape[2] < len(_COLOURS):
            return points, None
        return points, np.moveaxis(np.asarray(image[..., :3], float), 2, 0)

"""A triangle mesh of the fused cloud, on request."""

from pathlib import Path

import numpy as np

from stitch.runs.run import FusedCloud
from stitch.system.native import load_open3d

_DEPTH = 9
# Poisson closes what nobody saw; the least supported 4 % of its vertices are such fill.
_UNSUPPORTED = 0.04


def write_mesh(cloud: FusedCloud, path: Path) -> None:
    """Screened Poisson surface (Kazhdan & Hoppe 2013) of the fused points, trimmed where unsupported."""
    o3d = load_open3d()
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    points.normals = o3d.utility.Vector3dVector(cloud.normals)
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(points, depth=_DEPTH)
    density = np.asarray(density)
    mesh.remove_vertices_by_mask(density < np.quantile(density, _UNSUPPORTED))
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise OSError(f"{path}: mesh could not be written")

"""The arm as its makers drew it, at one view, where the session's URDF names meshes."""

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from stitch import frames
from stitch.frames import Array
from stitch.measurement.robot import LinkMesh, Robot, link_frames

if TYPE_CHECKING:
    import trimesh

_PAINT = (176, 182, 190)
# A recording is to be mailed: an arm of more triangles is shown as the chain of its joints alone.
_TRIANGLES = 120_000


def log_meshes(recording: rr.RecordingStream, robot: Robot, joints: Array) -> None:
    """Every link that has a mesh at joint angles (n,), base frame; nothing where they are too many to send.

    Meshes that cannot be read are left out: the chain of the joints stands there all the same.
    """
    shapes = [(own, mesh) for own in robot.meshes if (mesh := _read(own)) is not None]
    if sum(len(mesh.faces) for _, mesh in shapes) > _TRIANGLES:
        return
    T_base_link = link_frames(robot, joints)
    for i, (own, mesh) in enumerate(shapes):
        places = frames.transform(T_base_link[own.link] @ own.T_link_mesh, np.asarray(mesh.vertices) * own.scale)
        normals = frames.rotate(T_base_link[own.link] @ own.T_link_mesh, np.asarray(mesh.vertex_normals))
        shown = rr.Mesh3D(
            vertex_positions=np.float32(places),
            vertex_normals=np.float32(normals),
            triangle_indices=mesh.faces,
            albedo_factor=_PAINT,
        )
        recording.log(f"robot/links/{own.link} {own.file.stem} {i}", shown, static=True)


def _read(own: LinkMesh) -> "trimesh.Trimesh | None":
    # Few sessions bring meshes: the others do not wait for their library.
    import trimesh

    try:
        mesh = trimesh.load(own.file, force="mesh")
    except Exception:  # whatever a reader of some format meets in a file of a stranger
        return None
    return mesh if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) else None

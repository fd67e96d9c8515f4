"""The cell in the base frame: the arm at every view, the scanner's field, and the part."""

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.run_data import RunData
from stitch.session.robot import LinkMesh, Robot, link_frames
from stitch.session.scan import even_indices
from stitch.system.threads import take_mapped
from viz.colours import view_colours
from viz.run_numbers import shown_points

if TYPE_CHECKING:
    import trimesh


# The arm as its makers drew it, at one view, where the session's URDF names meshes.

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
        recording.log(["robot", "links", f"{own.link} {own.file.stem} {i}"], shown, static=True)


def _read(own: LinkMesh) -> "trimesh.Trimesh | None":
    # Few sessions bring meshes: the others do not wait for their library.
    import trimesh

    try:
        mesh = trimesh.load(own.file, force="mesh")
    except Exception:  # whatever a reader of some format meets in a file of a stranger
        return None
    return mesh if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) else None


# Of lines, in pixels.
_THIN, _DOT = rr.Radius.ui_points(1.0), rr.Radius.ui_points(6.0)
_GREY, _PART, _SCANNER, _TUBES = (110, 110, 110), (190, 195, 200), (230, 159, 0), (150, 156, 164)
# Radius of a link as a share of the arm's length.
_TUBE = 0.012
_SEEN = 0.98  # share of the points that lie within the drawn field of the scanner
_POINTS = 20_000
# Views at which the arm is shown alone.
_VIEWS = 400
# Of the field, where the scanner stood at the other views: as large as it is they would hide the part.
_SMALL = 0.15


def log_robot(recording: rr.RecordingStream, run: RunData) -> Array:
    """Chain of joints where the arm is known, else the flanges; the scanner's field, small for all views but the first.

    Returns:
        (N, 3) some points of the cell, base frame.
    """
    flange = np.array([view.T_base_flange for view in run.session.views])
    colours, names = view_colours(len(flange)), run.session.names
    recording.log("robot", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    arm = _log_arm(recording, run, flange)
    corners = _frustum(run)
    in_hand = run.session.mount == "eye_in_hand"
    T_base_scanner = flange @ run.T_mount if in_hand else run.T_mount[None]
    _log_reached(recording, arm, names)
    seen = [arm.reshape(-1, 3)]
    for v, (name, T, colour) in enumerate(zip(names, T_base_scanner, colours, strict=False)):
        lines = [frames.transform(T, strip if v == 0 else _SMALL * strip) for strip in corners]
        seen.append(np.concatenate(lines))
        shown, label = (_SCANNER if v == 0 else colour, name) if in_hand else (_SCANNER, "scanner")
        recording.log(f"robot/scanner/{label}", rr.LineStrips3D(lines, colors=[shown], radii=_THIN), static=True)
    points = take_mapped(run.fused.points, even_indices(len(run.fused.points), _POINTS))
    recording.log("robot/part", rr.Points3D(points.astype(np.float32), colors=[_PART]), static=True)
    if not in_hand:
        _log_carried(recording, flange)
        points = frames.transform(flange[0], points)
    first = "" if in_hand else f" at {names[0]}"
    _log_names(
        recording,
        {
            "robot's base": np.zeros(3),
            f"scanner at {names[0]}" if in_hand else "scanner": T_base_scanner[0, :3, 3],
            f"part{first}": points.mean(axis=0),
        },
    )
    return np.concatenate(seen)


def _log_names(recording: rr.RecordingStream, places: dict[str, Array]) -> None:
    """Log the names of the bodies at their places."""
    named = rr.Points3D(
        np.array(list(places.values())),
        labels=list(places),
        colors=[_PART],
        radii=rr.Radius.ui_points(2.5),
        show_labels=True,
    )
    recording.log("robot/names", named, static=True)


def _log_carried(recording: rr.RecordingStream, flange: Array) -> None:
    """Let the part follow the flanges (V, 4, 4) on the timeline `view`; elsewhere it is where the first view has it."""
    shown = even_indices(len(flange), _VIEWS)
    for timeline, at, T in (("view", shown, flange[shown]), ("iteration", np.zeros(1, np.int64), flange[:1])):
        placed = rr.Transform3D.columns(
            translation=T[:, :3, 3].astype(np.float32), mat3x3=T[:, :3, :3].astype(np.float32)
        )
        recording.send_columns("robot/part", [rr.TimeColumn(timeline, sequence=at)], placed)


def _tubes(chain: Array) -> dict[str, Array]:
    """Return the links of a chain (P, 3) as capsules: where they begin, how long, thick and turned they are."""
    links = np.diff(chain, axis=0)
    length = np.linalg.norm(links, axis=1)
    links, begin, length = links[length > 0], chain[:-1][length > 0], length[length > 0]
    way = links / length[:, None]
    # Half way between the axis z, along which capsules lie, and the link.
    half = way + np.array([0.0, 0.0, 1.0])
    size = np.linalg.norm(half, axis=1, keepdims=True)
    axis = np.where(size > 1e-6, half / np.maximum(size, 1e-12), np.array([1.0, 0.0, 0.0]))
    turned = np.column_stack([axis, np.zeros(len(axis))])
    thick = _TUBE * float(length.sum()) * np.ones(len(length))
    return {"translations": begin, "lengths": length, "radii": thick, "quaternions": turned}


def _log_reached(recording: rr.RecordingStream, arm: Array, names: list[str]) -> None:
    """Where each view has the arm (V, P, 3), or its flange alone, on the timeline `view`."""
    shown = even_indices(len(names), _VIEWS)
    at, colours = [rr.TimeColumn("view", sequence=shown)], [_SCANNER] * len(shown)
    for v in shown if arm.shape[1] > 1 else []:
        for timeline in ("view", "iteration")[: 1 + (v == 0)]:
            recording.set_time(timeline, sequence=int(v))
            recording.log("robot/reached", rr.Capsules3D(**_tubes(arm[v]), colors=[_TUBES], fill_mode="solid"))
            recording.reset_time()
    ends = rr.Points3D.columns(
        positions=arm[shown, -1],
        colors=colours,
        radii=[_DOT] * len(shown),
        labels=[names[v] for v in shown],
        show_labels=[True] * len(shown),
    )
    recording.send_columns("robot/reached/flange", at, ends)


def _log_arm(recording: rr.RecordingStream, run: RunData, flange: Array) -> Array:
    """Log the arm at all views, and return its joints (V, P, 3), or its flange alone where no joints are known."""
    robot, joints = run.session.robot, run.session.joints
    if robot is None or joints is None:
        chains = flange[:, None, :3, 3]
        recording.log("robot/path", rr.LineStrips3D([flange[:, :3, 3]], colors=[_GREY], radii=_THIN), static=True)
    else:
        chains = link_frames(robot, joints)[..., :3, 3]
        log_meshes(recording, robot, joints[0])
        recording.log("robot/arm", rr.LineStrips3D(chains, colors=[_GREY], radii=_THIN), static=True)
        recording.log(
            "robot/joints", rr.Points3D(chains[0], colors=[_GREY], radii=rr.Radius.ui_points(2.5)), static=True
        )
    recording.log(
        "robot/flanges",
        rr.Points3D(flange[:, :3, 3], colors=view_colours(len(flange)), radii=rr.Radius.ui_points(2.5)),
        static=True,
    )
    return np.asarray(chains)


def _frustum(run: RunData) -> list[Array]:
    """Line strips in the scanner frame: what the scanner sees, to the farthest points."""
    points = np.concatenate([shown_points(view) for view in run.session.views])
    # A tracker sees all around: it has no frustum.
    points = points[points[:, 2] > 0]
    if not len(points):
        return [np.zeros((2, 3))]
    a, b = (np.quantile(np.abs(points[:, i] / points[:, 2]), _SEEN) for i in range(2))
    depth = float(np.quantile(points[:, 2], _SEEN))
    corners = depth * np.array([[a, b, 1], [-a, b, 1], [-a, -b, 1], [a, -b, 1]])
    return [corners[[0, 1, 2, 3, 0]], *(np.array([np.zeros(3), corner]) for corner in corners)]

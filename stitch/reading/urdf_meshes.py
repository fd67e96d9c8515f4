"""How the links of a URDF look: the mesh files that its <visual> elements name."""

from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.robot import LinkMesh
from stitch.reading.urdf_elements import Element, attribute_numbers, fixed_links, link_name, origin


def link_meshes(
    root: Element, chain: list[Element], folder: Path, scale: float, T_flange_last: Array
) -> tuple[LinkMesh, ...]:
    """Meshes of the links of a chain and of what is fixed to them.

    What has no file, or no numbers where it stands, is left out: a picture is no reason to refuse an arm.

    Args:
        chain: joints from base to flange, fixed ones among them.
        folder: of the URDF; names begin there, those of a package wherever above it the rest of the name fits.
        scale: length_unit in a metre.
        T_flange_last: (4, 4) frame of the last turning joint's link in that of the flange.
    """
    turning = [joint for joint in chain if joint.get("type") != "fixed"]
    links = [link_name(chain[0], "parent"), *(link_name(joint, "child") for joint in turning)]
    found = []
    for i, link in enumerate(links):
        T_frame_link = T_flange_last if i == len(turning) else np.eye(4)
        for element, T in fixed_links(root, link, scale):
            for visual in element.findall("visual"):
                mesh = _mesh(visual, folder, scale)
                if mesh is not None:
                    T_link_mesh, file, own = mesh
                    found.append(LinkMesh(i, T_frame_link @ T @ T_link_mesh, file, own))
    return tuple(found)


def _mesh(visual: Element, folder: Path, scale: float) -> tuple[Array, Path, Array] | None:
    """Where a visual stands on its link (4, 4), its file and scale (3,)."""
    mesh = visual.find("geometry/mesh")
    file = None if mesh is None else _file(mesh.get("filename") or "", folder)
    if file is None:
        return None
    try:
        return origin(visual, scale, "visual"), file, attribute_numbers(mesh, "scale", "1 1 1", "visual") * scale
    except InputError:
        return None


def _file(name: str, folder: Path) -> Path | None:
    """The file that a URDF names: beside it, or package://name/rest in a folder above it."""
    kind, mark, rest = name.rpartition("://")
    if not rest or (mark and kind not in ("file", "package")):
        return None
    places = [folder / rest]
    if kind == "package":
        inside = rest.partition("/")[2]
        places = [above / path for above in (folder, *folder.resolve().parents) for path in (rest, inside) if path]
    try:
        return next((place for place in places if place.is_file()), None)
    except (OSError, ValueError):
        return None

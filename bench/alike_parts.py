"""Parts that look alike from several sides, and sessions of four and five views: what is left out, and what is doubted.

Run: python bench/alike_parts.py [--seed S] [--cells N] [--write]; the tables of docs/integrity.md. The cells are those
of `blade` and `blade-table` with all that their scenes have in them. Nothing is hidden and no view is wrong in the
first table; in the second each session is also run with one view 0.4 mm beside its row.
"""

import argparse
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from batch import into_page
from integrity_faults import displaced
from scipy.spatial.transform import Rotation

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import simulated
from data_synth.scene import Scene, load_scene
from data_synth.shapes.solid import circle, extrude, to_mesh, union
from stitch.api.pipeline import run
from stitch.errors import StitchError
from stitch.session.session import SessionData

PAGE = Path(__file__).resolve().parents[1] / "docs" / "integrity.md"
SCENES = ("blade", "blade-table")
VIEWS, RAYS, BESIDE = 14, 140, 0.4
# A number that somebody is told to type in.
TYPED = re.compile(r"would fit|write .*\d|: correct it")


def rotor(blades: int = 7) -> trimesh.Trimesh:
    """A hub with twisted blades, mm."""
    hub = to_mesh(extrude(circle(24.0), -22.0, 22.0))
    blade = trimesh.creation.box((52.0, 26.0, 3.0))
    blade.apply_transform(trimesh.transformations.rotation_matrix(np.radians(35), (1, 0, 0)))
    blade.apply_translation((46.0, 0.0, 0.0))
    turned = [blade.copy().apply_transform(turn) for turn in turns(blades)]
    return trimesh.boolean.union([hub, *turned], engine="manifold")


def drum(teeth: int = 24) -> trimesh.Trimesh:
    """A cylinder with teeth along it, mm."""
    tooth = trimesh.creation.box((6.0, 6.0, 70.0))
    tooth.apply_translation((57.0, 0.0, 0.0))
    body = to_mesh(extrude(circle(56.0, sides=480), -35.0, 35.0))
    return trimesh.boolean.union(
        [body, *(tooth.copy().apply_transform(turn) for turn in turns(teeth))], engine="manifold"
    )


def flange(holes: int = 8) -> trimesh.Trimesh:
    """A disc with a neck and a ring of holes, mm."""
    solid = union([extrude(circle(65.0), -12.0, 0.0), extrude(circle(28.0), -1.0, 40.0)])
    for angle in 2 * np.pi * np.arange(holes) / holes:
        solid -= extrude(circle(6.0, 48.0 * np.array([np.cos(angle), np.sin(angle)])), -13.0, 1.0)
    return to_mesh(solid - extrude(circle(18.0), -13.0, 41.0))


def turns(count: int) -> list[np.ndarray]:
    """Turns (4, 4) about z by equal parts of a circle."""
    return [trimesh.transformations.rotation_matrix(2 * np.pi * i / count, (0, 0, 1)) for i in range(count)]


PARTS = {"rotor of seven blades": rotor, "drum of 24 teeth": drum, "flange with eight holes": flange}


def scene_with(name: str, mesh: Path | None) -> Scene:
    """A scene with fewer rays, and with another part if one is given."""
    scene = load_scene(name)
    scene = replace(scene, scanner=replace(scene.scanner, columns=RAYS, rows=RAYS))
    return scene if mesh is None else replace(scene, part=replace(scene.part, mesh=str(mesh), labelled=False))


def said_of(session: SessionData) -> tuple[int, bool, str]:
    """How many views a run leaves out, whether it tells to type a number, and its first doubt or its refusal."""
    try:
        found = run(session)
    except StitchError as error:
        return 0, bool(TYPED.search(str(error))), f"refused: {error}"
    told = [*found.doubts, *(item.why for item in found.left_out)]
    return len(found.left_out), any(TYPED.search(line) for line in told), next(iter(found.doubts), "")


def alike(first: int, cells: int) -> list[str]:
    """The table of parts that look alike."""
    lines = [
        "| part | cells | with a view left out | with a number to type in | refused or doubted |",
        "|---|---:|---:|---:|---:|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name, build in PARTS.items():
            mesh = Path(folder) / f"{build.__name__}.ply"
            build().export(mesh)
            rows = []
            for seed in range(first, first + cells):
                rows.append(said_of(session_of(simulated(scene_with(SCENES[seed % 2], mesh), {}, seed, VIEWS))))
                print(name, seed, rows[-1], flush=True)
            counts = [sum(bool(row[i]) for row in rows) for i in range(3)]
            lines.append(f"| {name} | {cells} | {counts[0]} | {counts[1]} | {counts[2]} |")
    return lines


def few(first: int, cells: int) -> list[str]:
    """The table of four and five views."""
    lines = [
        "| views | cells | all right: doubted | a view named | one off: doubted | it named | another | nothing said |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for views in (4, 5):
        counts = np.zeros(6, int)
        for seed in range(first, first + cells):
            session = session_of(simulated(scene_with(SCENES[seed % 2], None), {}, seed, views))
            rng = np.random.default_rng([seed, 17])
            wrong, way = int(rng.integers(views)), Rotation.random(random_state=rng).as_matrix()[0]
            doubted, named = doubted_and_named(session)
            counts[:2] += (doubted, bool(named))
            doubted, named = doubted_and_named(displaced({wrong: np.r_[np.zeros(3), BESIDE * way]})(session))
            it = session.names[wrong]
            counts[2:] += (doubted, it in named, bool(named - {it}), not doubted and not named)
            print(views, seed, counts.tolist(), flush=True)
        lines.append(f"| {views} | {cells} | " + " | ".join(str(n) for n in counts) + " |")
    return lines


def doubted_and_named(session: SessionData) -> tuple[bool, set[str]]:
    """Whether a run doubts the session as a whole or refuses it, and the views that it leaves out or says stand out."""
    try:
        found = run(session)
    except StitchError:
        return True, set()
    notes = " ".join(note for note in found.notes if "stand out" in note or "stands out" in note)
    return bool(found.doubts), {i.view for i in found.left_out} | {name for name in session.names if name in notes}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=5200)
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--only", choices=["alike", "few-views"])
    parser.add_argument("--write", action="store_true", help="put the tables into docs/integrity.md")
    given = parser.parse_args()
    for name, table in (("alike", alike), ("few-views", few)):
        if given.only not in (None, name):
            continue
        lines = table(given.seed, given.cells)
        print("\n".join(lines))
        if given.write:
            into_page(name, lines, PAGE)


if __name__ == "__main__":
    main()

"""Does Open3D find a hand-eye where the own coarse search does not? Tables of docs/dependencies.md.

`python -m bench.second_opinion [measured] [simulated] [--seed 0] [--write]`. No hand-eye is known. Neighbouring views
are registered by Open3D: FPFH with RANSAC, and fast global registration. The motions go through the same five solvers,
their hand-eyes are closed in as the own starts are, and the best of both is taken. Right: the part is placed within 3 %
of its size of the truth, which for measured objects is the whole run of all views.

Cells: five measured objects whole, and with every other view; simulated blades, spheres, door panels and drilled
plates of three, four and five views.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np

import stitch
from data_synth.fixtures.in_memory import session_of
from data_synth.scene import load_scene
from data_synth.simulate import simulate
from stitch.errors import NoResultError
from stitch.fit.coarse import (
    HandEyeCandidate,
    consistent_motions,
    distinct_hand_eyes,
    even_grid_size,
    find_coarse_hand_eye,
    icp_from_starts,
    neighbouring_views,
    robot_motions,
    same_hand_eye,
)
from stitch.numerics.frames import Array
from stitch.numerics.hand_eye import AXXB_SOLVERS
from stitch.session.capture import Capture, part_size, prepare_capture
from stitch.system.open3d_library import import_open3d
from stitch.system.threads import library_threads_off

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "dependencies.md"
SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data")
OBJECTS = ("david", "cone", "sphere", "rubik", "gripperopen")
SCENES = ("blade", "calibration-sphere", "car-door", "drill-plate")
CLOSE = 1.1  # two answers whose scores differ by less are equally good: the search is unsure


def motions(o3d, capture: Capture, way: str) -> Array:
    """Return the motions (M, 4, 4) of neighbouring scans by Open3D."""
    registration, step = o3d.pipelines.registration, max(even_grid_size(s.points) for s in capture.scans)

    def described(points: Array):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, float))).voxel_down_sample(step)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * step, max_nn=30))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        feature = registration.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(5 * step, 100))
        return cloud, feature

    shown = [described(scan.points) for scan in capture.scans]
    out = []
    for v, w in neighbouring_views(len(shown)):
        (target, target_feature), (source, source_feature) = shown[v], shown[w]
        if way == "FGR":
            option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=step)
            found = registration.registration_fgr_based_on_feature_matching(
                source, target, source_feature, target_feature, option
            )
        else:
            checks = [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(1.5 * step),
            ]
            found = registration.registration_ransac_based_on_feature_matching(
                source,
                target,
                source_feature,
                target_feature,
                True,
                1.5 * step,
                registration.TransformationEstimationPointToPoint(False),
                3,
                checks,
                registration.RANSACConvergenceCriteria(100_000, 0.999),
            )
        out.append(found.transformation)
    return np.array(out)


def hand_eyes(capture: Capture, B: Array) -> list[tuple[str, Array]]:
    """Return the hand-eyes that the motions give, with the names of their solvers."""
    A, B = consistent_motions(robot_motions(capture, neighbouring_views(len(capture.scans))), B)
    out = []
    for name, solver in AXXB_SOLVERS.items() if len(A) >= 3 else ():
        try:
            T = solver(A, B)
        except (NoResultError, np.linalg.LinAlgError):
            continue
        out += [(name, T)] if np.isfinite(T).all() else []
    return out


def verdict(capture: Capture, tried: list[HandEyeCandidate], truth: Array) -> tuple[str, float]:
    """Return right, unsure or wrong, and the score of the best."""
    size = part_size([capture])
    answers = distinct_hand_eyes([capture], tried, size)
    if not answers:
        return "none", np.inf
    right = same_hand_eye([capture], size, answers[0].T_mount, truth)
    unsure = len(answers) > 1 and answers[1].score < CLOSE * answers[0].score
    return ("right" if right else "wrong") + (", unsure" if unsure else ""), answers[0].score


def opinions(capture: Capture, truth: Array, o3d) -> dict[str, str]:
    """Return what each search says of one cell, and its processor seconds."""
    size, out = part_size([capture]), {}
    began = time.process_time()
    try:
        own = list(find_coarse_hand_eye([capture]).candidates)
    except NoResultError:
        own = []
    out["own"] = verdict(capture, own, truth)[0]
    out["own seconds"] = f"{time.process_time() - began:.1f}"
    for way in ("RANSAC", "FGR"):
        began = time.process_time()
        starts = hand_eyes(capture, motions(o3d, capture, way))
        theirs = icp_from_starts([capture], starts, size) if starts else []
        out[f"{way} alone"] = verdict(capture, theirs, truth)[0]
        out[f"own and {way}"] = verdict(capture, own + theirs, truth)[0]
        out[f"{way} seconds"] = f"{time.process_time() - began:.1f}"
    return out


def measured_cells():
    """Yield name, capture and hand-eye by the whole run of the measured objects, whole and every other view."""
    for name in OBJECTS:
        session = stitch.load_session(SHARED / "reghec" / name)
        truth = stitch.run(session).T_mount
        yield name, prepare_capture(session), truth
        yield f"{name}, 5 views", prepare_capture(session.without(session.names[1::2])), truth


def simulated_cells(seed: int):
    """Yield name, capture and true hand-eye of the simulated cells."""
    for number in range(12):
        scene, views = SCENES[number % 4], (3, 4, 5)[number // 4]
        measured = simulate(load_scene(scene), {}, seed + number, views)
        yield f"{scene}, {views} views", prepare_capture(session_of(measured)), measured.T_mount


def table(found: list[dict[str, str]], kind: str) -> str:
    """Return the table of some cells."""
    lines = [
        f"| {len(found)} {kind} cells | right | of these unsure | processor seconds, median |",
        "|---|---:|---:|---:|",
    ]
    for way in ("own", "RANSAC alone", "FGR alone", "own and RANSAC", "own and FGR"):
        right = [own[way] for own in found if own[way].startswith("right")]
        of = [word for word in ("own", "RANSAC", "FGR") if word in way]
        seconds = np.median([sum(float(own[f"{word} seconds"]) for word in of) for own in found])
        lines.append(f"| {way} | {len(right)} | {sum('unsure' in text for text in right)} | {seconds:.1f} |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables, and write them into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=["measured", "simulated"], help="both, unless named")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/dependencies.md")
    options = parser.parse_args()
    o3d = import_open3d("bench")
    for kind in options.kinds:
        found = []
        o3d.utility.random.seed(0)
        with library_threads_off():
            for name, capture, truth in measured_cells() if kind == "measured" else simulated_cells(options.seed):
                found.append(opinions(capture, truth, o3d))
                print(name, found[-1], flush=True)
        print(f"\n{table(found, kind)}")
        if options.write:
            begin, end = (f"<!-- {kind} opinions: {word} -->" for word in ("begin", "end"))
            before, rest = PAGE.read_text(encoding="utf-8").split(begin)
            text = f"{before}{begin}\n{table(found, kind)}\n{end}{rest.split(end)[1]}"
            PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

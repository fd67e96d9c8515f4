"""Folders as people have them, through `stitch init`: python bench/field_folders.py [--cases] [--kinds] [--tables]

--cases goes through ../shared/cases (STITCH_SHARED_CASES names another place), --kinds through the ways of writing in
data_synth/fixtures/field_folders.py, --only NAME through one. Where init refuses, what it asks for is done to the
letter, and it is asked again. Right: the views meet under the true hand-eye (cases), or poses, mount and pairing are
those of the campaign (kinds). --run goes on with the cases: `stitch run` has to find the true hand-eye within twice its
U, and to say of what it cannot know that it is not known. --tables writes the table of docs/own-data.md. --drawn SEED
draws sixty ways of writing another campaign (data_synth/fixtures/field_drawn.py).
"""

import argparse
import io
import json
import os
import re
import shutil
import time
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.field_drawn import draw_kinds
from data_synth.fixtures.field_folders import KINDS, Campaign, Kind, rescale
from data_synth.write import write_session
from stitch.cli.main import main as stitch
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.urdf_file import to_urdf
from stitch.session.reading.session_folder import load_session
from stitch.session.session import SessionData

ROOT = Path(__file__).resolve().parents[1]
CASES = Path(os.environ.get("STITCH_SHARED_CASES") or ROOT.parent / "shared" / "cases")
PAGE = ROOT / "docs" / "own-data.md"
BEGIN, END = "<!-- field: begin -->\n", "<!-- field: end -->"
# The hand-eye behind the cases; under it the views of a right session lie this near to each other, mm.
T_CASES = frames.make(Rotation.from_rotvec([0.080, -0.120, 0.750]).as_matrix(), np.array([62.0, -38.0, 95.0]))
MEET_MM, _NEIGHBOURS = 0.15, 8
# Of positions as tables round them.
NEAR_MM = 0.05
# Of the distance of clouds from the scanner, as a share.
SIZE = 5e-3
# Where the true hand-eye is another, or a wrist that never turns leaves it open.
TURNTABLE, NO_HAND_EYE = (
    "turntable_names_only",
    ("gantry_constant_rotation", "line_profiles_xyz", "bag_without_tf_static", "quaternion_2_decimals"),
)


# The cases as the page calls them.
CALLED = {
    "bag_without_tf_static": "bag without the scanner's frame in tf",
    "depth_counts_0.1mm": "depth images that count 0.1 mm, intrinsics without depth_scale",
    "e57_many_scans_one_file": "one E57 with ten scans and their poses",
    "fanuc_j3_coupling": "joints of a FANUC as its pendant shows them, j3 with j2",
    "gantry_constant_rotation": "poses whose rotation never changes",
    "halcon_pose_dat": "pose files of HALCON",
    "invalid_minus_99999": "clouds with -99999 where nothing was measured",
    "joint_states_elbow_first": "joint_states in the order of the alphabet, with the URDF",
    "kuka_pos_act_log": "a log of E6POS",
    "label_colon_first_number": 'rows "pose 0: 0.83, …"',
    "line_profiles_xyz": "laser profiles of a sphere",
    "minus_inf_pose": "one pose file of -inf",
    "one_empty_cloud": "one empty cloud",
    "ply_blank": "PLY with blank lines in the header",
    "posegraph_json": "Open3D's pose graph",
    "posegraph_ring": "Open3D's pose graph with as many edges as nodes",
    "q0_q3_is_xyzw": "q0 … q3 over x, y, z, w",
    "quaternion_2_decimals": "quaternions of two decimals",
    "rail_e1": "a column E1 of the rail beside the poses",
    "redwood_log": "trajectory.log of Open3D",
    "rtde_125hz": "a recording of RTDE at 125 Hz",
    "three_views_missing": "three clouds missing of ten numbered",
    "turntable_names_only": "a turntable's angle in the names",
    "xyz_with_count": ".xyz with the number of points above them",
}


@dataclass
class Outcome:
    """What became of one folder."""

    code: int
    seconds: float  # of the processor, which other work on the machine does not change
    said: str

    @property
    def refusal(self) -> str:
        """The sentence of a refusal."""
        return self.said.strip().splitlines()[-1] if self.code else ""


def command(*words: str) -> Outcome:
    """Run a command as a person does who has no terminal."""
    said, begin, code = io.StringIO(), time.process_time(), 0
    with redirect_stderr(said), redirect_stdout(said):
        try:
            stitch(list(words))
        except SystemExit as end:
            code = int(end.code or 0)
    return Outcome(code, time.process_time() - begin, said.getvalue())


def init(folder: Path, out: Path, *flags: str) -> Outcome:
    """Run `stitch init` on a folder."""
    shutil.rmtree(out, ignore_errors=True)
    return command("init", str(folder), "--yes", "-o", str(out), *flags)


def follow(refusal: str, folder: Path, campaign: Campaign | None = None) -> tuple[str, ...] | None:
    """Do what a refusal asks for, and return the flags that it asks for; None where it asks for something else."""
    if found := re.search(r'^stitch: (\S+): .*as "depth_scale": (\S+)$', refusal):
        file = Path(found[1])
        file.write_text(file.read_text().rstrip().rstrip("}") + f', "depth_scale": {found[2]}}}')
        return ()
    if "--ball RADIUS" in refusal:
        return ("--ball", "30")
    if found := re.search(r"multiply x, y, z of the clouds by (\S+),", refusal):
        return rescale(float(found[1]))(folder)
    if "put the URDF" in refusal and (away := list(folder.glob("*.urdf.gone"))):
        away[0].rename(away[0].with_suffix(""))
        return ()
    if "--orientation" in refusal and campaign is not None:
        return ("--orientation", ",".join(f"{x:.8f}" for x in campaign.R.as_quat()[0]))
    found = re.search(r"state (--[a-z-]+) (\S+)$", refusal)
    return (found[1], found[2]) if found else None


def apart(session: SessionData, T_mount: Array) -> float:
    """Return the median distance (mm) of points from planes through their neighbours in the next view."""
    scale = {"mm": 1.0, "m": 1e3}[session.length_unit]
    placed = []
    for view in session.views:
        T = np.array(view.T_base_flange)
        T[:3, 3] *= scale
        T = T if session.mount == "eye_in_hand" else frames.inverse(T[None])[0]
        placed.append(frames.transform(T @ T_mount, view.cloud.points * scale))
    found = []
    for points, others in pairwise(placed):
        near = others[cKDTree(others).query(points[::9], k=_NEIGHBOURS)[1]]
        middle = near.mean(axis=1)
        normal = np.linalg.svd(near - middle[:, None])[2][:, 2]
        found.append(np.median(np.abs(np.einsum("ni,ni->n", points[::9] - middle, normal))))
    return float(np.median(found))


def case_verdict(name: str, out: Path) -> str:
    """Judge the session of a case."""
    session = load_session(out)
    if name == TURNTABLE:
        return "right" if turns(session, [float(re.findall(r"\d+", v.name)[-1]) for v in session.views]) else "wrong"
    if name in NO_HAND_EYE:
        return "right" if session.mount == "eye_in_hand" else "wrong"
    return "right" if apart(session, T_CASES) < MEET_MM else f"wrong ({apart(session, T_CASES):.2f} mm)"


def turns(session: SessionData, degrees: Sequence[float]) -> bool:
    """True if the poses turn the part about z by these angles, all in one sense."""
    T = np.array([view.T_base_flange for view in session.views])
    angles = np.degrees(np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0])))
    wanted = np.array(degrees) - degrees[0]
    off = min(np.abs((sign * (angles - angles[0]) - wanted + 180) % 360 - 180).max() for sign in (1, -1))
    return session.mount == "eye_to_hand" and off < 0.01 and np.allclose(T[:, :3, 3], 0)


def run_verdict(name: str, out: Path) -> str:
    """Run the session of a case, and judge the hand-eye by the true one."""
    folder = out.with_name(f"{out.name}-run")
    if name == "line_profiles_xyz":
        done = command("calibrate", "sphere", str(out), "-o", str(folder), "--json")
        return sphere_verdict(done)
    done = command("run", str(out), "-o", str(folder), "--no-recording")
    if done.code:
        return f"run refused: {done.refusal}"
    said = json.loads((folder / "result.json").read_text())
    scale = np.repeat([1.0, {"mm": 1.0, "m": 1e3}[said["length_unit"]]], 3)
    T = np.array(said["hand_eye"])
    T[:3, 3] *= scale[3]
    sigma = np.array([np.nan if x is None else x for x in said["hand_eye_sigma"]]) * scale
    off = np.abs(frames.log((frames.inverse(T_CASES[None]) @ T)[0])) / (2 * sigma)
    unknown, left = said["hand_eye_unknown"], len(said["left_out"])
    known = off[:3] if {"x", "y", "z"} <= set(unknown) else off
    words = f"; not known: {', '.join(unknown)}" if unknown else ""
    words += f"; {left} left out" if left else ""
    if name in (TURNTABLE, "bag_without_tf_static", "crash-steps-6-views", "duplicated-points"):
        return f"{said['residual_rms'] * scale[3]:.3f} mm rms{words}; {done.seconds:.0f} s"
    good = "right" if (known < 2).all() else "wrong"
    return f"{good}, {known.max():.1f} U off{words}; {done.seconds:.0f} s"


def sphere_verdict(done: Outcome) -> str:
    """Judge the hand-eye of `stitch calibrate sphere`."""
    if done.code:
        return f"refused: {done.refusal}"
    T = np.array(json.loads(done.said[done.said.index("{") : done.said.rindex("}") + 1])["hand_eye"])
    return f"{np.linalg.norm(T[:3, 3] - T_CASES[:3, 3]):.3f} mm off"


def run_cases(scratch: Path, only: str | None, go_on: bool) -> list[list[str]]:
    """Every case with a folder `in`, on a copy of it; with `go_on` its run, and the cases that are sessions."""
    rows = []
    for case in sorted(CASES.iterdir()):
        if only is not None and not re.search(only, case.name):
            continue
        if go_on and (case / "session").is_dir():
            shutil.copytree(case / "session", scratch / case.name)
            rows.append([case.name, run_verdict(case.name, scratch / case.name), "", ""])
            print(" | ".join(rows[-1]), flush=True)
        if not (case / "in").is_dir():
            continue
        folder, out = scratch / case.name, scratch / f"{case.name}-session"
        shutil.copytree(case / "in", folder)
        bag = next((f.parent for f in folder.rglob("metadata.yaml")), folder)
        first = last = init(bag, out)
        flags = follow(first.refusal, folder) if first.code else None
        if flags is not None:
            last = init(bag, out, *flags)
        verdict = case_verdict(case.name, out) if not last.code else "refused"
        if last.code and "pip install" in last.refusal:
            verdict = "needs a package"
        told = first.refusal.partition("; to fix: ")[2] if first.code else ""
        verdict += " once it is stated" if flags is not None else ""
        verdict += f"; run: {run_verdict(case.name, out)}" if go_on and not last.code else ""
        rows.append([case.name, verdict, f"{first.seconds:.1f}", told])
        print(" | ".join(rows[-1]), flush=True)
    return rows


def campaigns(scratch: Path, seed: int = 11) -> dict[str, Campaign]:
    """The campaign with joints, one of a part on a turntable, and one of a wrist that never turns."""
    measured = measured_blade(seed, views=10, mount="eye_in_hand", pixels=80, repeatability=(0.0, 0.0))
    write_session(scratch / "campaign", measured, "campaign")
    session = load_session(scratch / "campaign")
    T = np.array([view.T_base_flange for view in session.views])
    clouds = tuple(view.cloud.points for view in session.views)
    arm = Campaign(clouds, T, np.array([view.joints for view in session.views]), to_urdf(session.robot))
    part = np.vstack([frames.transform(pose @ measured.T_mount, c) for pose, c in zip(T, clouds, strict=True)])
    part -= part.mean(axis=0)
    angles = np.radians(np.arange(0, 360, 24.0))
    spun = frames.make(Rotation.from_rotvec(np.outer(angles, [0, 0, 1])).as_matrix(), np.zeros(3))
    X = frames.make(Rotation.from_euler("xz", [-115, 90], degrees=True).as_matrix(), np.array([400.0, 0.0, 130.0]))
    turned = []
    for pose in spun:
        points = frames.transform(pose, part)
        front = np.abs(np.arctan2(points[:, 1], points[:, 0])) < 1.2
        turned.append(frames.transform(frames.inverse(X[None])[0], points[front]))
    still = np.tile(T[0], (len(T), 1, 1))
    still[:, :3, 3] += np.random.default_rng(5).uniform(-25, 25, (len(T), 3))
    first = frames.transform(T[0] @ measured.T_mount, clouds[0])
    seen = [frames.transform(frames.inverse((pose @ measured.T_mount)[None])[0], first) for pose in still]
    return {"arm": arm, "turntable": Campaign(tuple(turned), spun), "still": Campaign(tuple(seen), still)}


def kind_verdict(kind: Kind, campaign: Campaign, out: Path) -> str:
    """Judge the session of a kind."""
    session = load_session(out)
    scale = {"mm": 1.0, "m": 1e3}[session.length_unit]
    if kind.turntable:
        angles = np.degrees(np.unwrap(np.arctan2(campaign.T[:, 1, 0], campaign.T[:, 0, 0])))
        return "right" if len(session.views) == len(campaign.T) and turns(session, angles.tolist()) else "wrong"
    middles = np.array([np.median(cloud, axis=0) for cloud in campaign.clouds])
    own = np.array([np.median(view.cloud.points, axis=0) * scale for view in session.views])
    which = np.linalg.norm(own[:, None] - middles, axis=2).argmin(axis=1)
    wanted = [i for i in range(len(middles)) if i not in (kind.views or ())]
    T = np.array([view.T_base_flange for view in session.views])
    T[:, :3, 3] *= scale
    size = np.median(np.linalg.norm(own, axis=1) / np.linalg.norm(middles[which], axis=1))
    if abs(size - 1) > SIZE:
        return f"wrong: clouds {size:.4g} times as large"
    if session.mount != "eye_in_hand" or sorted(which.tolist()) != wanted:
        return f"wrong: {session.mount}, views {sorted(which.tolist())}"
    shift = np.abs(T[:, :3, 3] - campaign.T[which][:, :3, 3]).max()
    turn = frames.angle_between(T, campaign.T[which]).max()
    return "right" if shift < NEAR_MM and turn < kind.near else f"wrong by {shift:.3g} mm, {turn:.2g} rad"


def run_kinds(scratch: Path, only: str | None) -> list[list[str]]:
    """Every kind, and its mend where it is refused."""
    rows = []
    known = campaigns(scratch)
    for name, kind in KINDS.items():
        if only not in (None, name):
            continue
        campaign = known["turntable" if kind.turntable else "still" if name == "xyz-alone" else "arm"]
        folder, out = scratch / name, scratch / f"{name}-session"
        folder.mkdir()
        kind.write(folder, campaign)
        first = last = init(folder, out, *kind.flags)
        if first.code and kind.expected and kind.mend and re.search(kind.expected, first.refusal):
            last = init(folder, out, *kind.mend(folder))
        if last.code:
            verdict = (
                "rightly refused" if kind.expected and re.search(kind.expected, last.refusal) else "wrongly refused"
            )
        else:
            verdict = kind_verdict(kind, campaign, out)
            verdict = verdict if verdict == "right" or "NOT TOLD" not in last.said else f"guessed, said so: {verdict}"
        words = first.refusal.partition("; to fix: ")[2] or first.refusal
        rows.append(
            [name, verdict + (" once it is stated" if last is not first else ""), f"{first.seconds:.1f}", words]
        )
        print(" | ".join(rows[-1]), flush=True)
    return rows


def run_drawn(scratch: Path, seed: int, only: str | None) -> list[list[str]]:
    """Sixty drawn kinds; where one is refused, what the refusal asks for is done to the letter."""
    rows, known = [], campaigns(scratch, seed)
    for name, kind in draw_kinds(seed).items():
        if only is not None and not re.search(only, name):
            continue
        campaign = known["turntable" if kind.turntable else "still" if name.startswith("still") else "arm"]
        folder, out = scratch / name.replace(" ", "-"), scratch / f"{name}-session"
        folder.mkdir()
        kind.write(folder, campaign)
        first = last = init(folder, out)
        flags = follow(first.refusal, folder, campaign) if first.code else None
        if flags is not None:
            last = init(folder, out, *flags)
        if last.code:
            right = kind.expected is not None and re.search(kind.expected, last.refusal)
            verdict = f"{'rightly' if right else 'wrongly'} refused"
        else:
            verdict = kind_verdict(kind, campaign, out)
            verdict = verdict if verdict == "right" or "NOT TOLD" not in last.said else f"guessed, said so: {verdict}"
        verdict += " once it is stated" if flags is not None else ""
        words = last.refusal or first.refusal
        rows.append([name, verdict, f"{first.seconds:.1f}", words])
        print(" | ".join(rows[-1]), flush=True)
    return rows


def table(rows: Sequence[Sequence[str]]) -> str:
    """The rows for a page, without the seconds, which depend on the machine."""
    head = "| folder | what becomes of it | what a refusal asks for |\n|---|---|---|\n"
    told = [(CALLED.get(name, name), verdict, re.sub(r"/\S+/", "", words)) for name, verdict, _, words in rows]
    return head + "".join(f"| {' | '.join(row)} |\n" for row in told)


def main() -> None:
    """Print the rows and how many are right."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", action="store_true")
    parser.add_argument("--kinds", action="store_true")
    parser.add_argument("--run", action="store_true")
    parser.add_argument("--only")
    parser.add_argument("--tables", action="store_true")
    parser.add_argument("--drawn", type=int, metavar="SEED")
    asked = parser.parse_args()
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        rows = run_cases(scratch, asked.only, asked.run) if asked.cases else []
        rows += run_kinds(scratch, asked.only) if asked.kinds else []
        rows += run_drawn(scratch, asked.drawn, asked.only) if asked.drawn is not None else []
    good = sum(row[1].startswith(("right", "rightly")) for row in rows)
    print(f"{good} of {len(rows)} right or rightly refused")
    if asked.tables:
        page = PAGE.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        PAGE.write_text(before + BEGIN + table(rows) + END + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()

"""Folders as people have them through `stitch init`: does it tell the right session?

FIELD: one simulated campaign in the ways of writing of data_synth/fixtures/field_folders.py. CASES: the folders of the
shared cases, each simulated after a thread of somebody who does this job; with `--set run=true`, `stitch run` has to
find the true hand-eye within twice its U, and to say of what it cannot know that it is not known. Where init refuses,
what it asks for is done to the letter, and it is asked again. Right: the views meet under the true hand-eye (cases), or
poses, mount and pairing are those of the campaign.

DRAWN: 300 folders of a seed, formats × layouts × conventions × units × names × mistakes, of
data_synth/fixtures/drawn_folders.py. Each is asked without guessing; where a question comes back, a person who knows
the cell answers it, one answer a time, by the data that the refusal carries. Right: every view that belongs there has
the pose, the unit and the mount of the campaign, and no other is there; or nothing can be right, and the refusal names
the true cause. A guess is marked if it bears "?"; a session that is wrong in what bears no mark is silently so.
"""

import io
import json
import re
import shutil
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bench.harness import SHARED_CASES, Row, Table, grouped, markdown, share
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.drawn_folders import MM, Truth, draw_folder
from data_synth.fixtures.field_folders import KINDS, Campaign, Kind
from data_synth.write import write_session
from stitch.cli.main import main as stitch
from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.urdf_file import to_urdf
from stitch.plugins.intake.guesses import Guess
from stitch.plugins.intake.make_session import Made, make_session
from stitch.plugins.intake.refusals import Refusal
from stitch.session.reading.session_folder import load_session
from stitch.session.session import SessionData

# The hand-eye behind the cases; under it the views of a right session lie this near to each other, mm.
T_CASES = frames.make(Rotation.from_rotvec([0.080, -0.120, 0.750]).as_matrix(), np.array([62.0, -38.0, 95.0]))
MEET_MM, _NEIGHBOURS = 0.25, 8
# Of positions as tables round them; of the distance of clouds from the scanner, as a share.
NEAR_MM, NEAR_RAD, SIZE = 0.05, 5e-4, 5e-3
# OpenGL's axes, and what a refusal has to say where it is right.
OTHER_HAND_EYES = {"nerfstudio_transforms": np.diag([1.0, -1.0, -1.0, 1.0])}
TRUE_CAUSES = {"tool_changed_midway": r"changed at scan_06\.ply, by \((-?0\.\d), (-?0\.\d), (149\.\d|150\.\d)\) mm"}
# Where the true hand-eye is another, a wrist that never turns leaves it open, or nothing of a run can be judged by it.
TURNTABLE = "turntable_names_only"
NO_HAND_EYE = (
    "gantry_constant_rotation",
    "line_profiles_xyz",
    "bag_without_tf_static",
    "quaternion_2_decimals",
    "scara_xyzu_points_csv",
)
NO_TRUE_HAND_EYE = (TURNTABLE, "bag_without_tf_static", "crash-steps-6-views", "duplicated-points")
_SEED = 11
# Answers that a person gives in turn; folders of one seed are written of so many campaigns.
_STEPS, _CAMPAIGNS = 3, 3


@dataclass
class Outcome:
    """How a command ended."""

    code: int
    seconds: float  # of the processor, which other work on the machine does not change
    said: str

    @property
    def refusal(self) -> str:
        """The sentence of a refusal."""
        return self.said.strip().splitlines()[-1] if self.code else ""


def command(*words: str) -> Outcome:
    """Run a command as a person does who has no terminal."""
    said = io.StringIO()
    begin, code = time.process_time(), 0
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


def follow(refusal: str, folder: Path) -> tuple[str, ...] | None:
    """Do what a refusal asks for, and return the flags that it asks for; None where it asks for something else."""
    if match := re.search(r'^stitch: (\S+): .*as "depth_scale": (\S+)$', refusal):
        file = Path(match[1])
        file.write_text(file.read_text().rstrip().rstrip("}") + f', "depth_scale": {match[2]}}}')
        return ()
    if "--ball RADIUS" in refusal:
        return ("--ball", "30")
    match = re.search(r"state (--[a-z-]+) (\S+)$", refusal)
    return (match[1], match[2]) if match else None


def case_jobs(seeds: range, run: bool) -> Iterator[Row]:
    """Every case that is a folder; with `run` those that are sessions too."""
    for case in sorted(SHARED_CASES.iterdir()):
        if run and (case / "session").is_dir():
            yield {"name": case.name, "run": True, "session": True}
        if (case / "in").is_dir():
            yield {"name": case.name, "run": run, "session": False}


def case_trial(job: Row) -> Row:
    """What becomes of a copy of the folder, and of its run."""
    name = job["name"]
    with TemporaryDirectory() as scratch:
        folder, out = Path(scratch) / name, Path(scratch) / f"{name}-session"
        if job["session"]:
            shutil.copytree(SHARED_CASES / name / "session", folder)
            return {"verdict": run_verdict(name, folder), "asked": ""}
        shutil.copytree(SHARED_CASES / name / "in", folder)
        bag = next((f.parent for f in folder.rglob("metadata.yaml")), folder)
        first = last = init(bag, out)
        flags = follow(first.refusal, folder) if first.code else None
        if flags is not None:
            last = init(bag, out, *flags)
        caused = name in TRUE_CAUSES and re.search(TRUE_CAUSES[name], last.refusal)
        verdict = "rightly refused" if caused else "refused" if last.code else case_verdict(name, out)
        if last.code and "pip install" in last.refusal:
            verdict = "needs a package"
        verdict += " once it is stated" if flags is not None else ""
        verdict += f"; run: {run_verdict(name, out)}" if job["run"] and not last.code else ""
        return {"verdict": verdict, "asked": first.refusal.partition("; to fix: ")[2]}


def case_verdict(name: str, out: Path) -> str:
    """Judge the session of a case."""
    session = load_session(out)
    if name == TURNTABLE:
        return "right" if turns(session, [float(re.findall(r"\d+", v.name)[-1]) for v in session.views]) else "wrong"
    if name in NO_HAND_EYE:
        return "right" if session.mount == "eye_in_hand" else "wrong"
    off = apart(session, OTHER_HAND_EYES.get(name, T_CASES))
    return "right" if off < MEET_MM else f"wrong ({off:.2f} mm)"


def run_verdict(name: str, out: Path) -> str:
    """Run the session of a case, and judge the hand-eye by the true one within twice its U."""
    folder = out.with_name(f"{out.name}-run")
    if name == "line_profiles_xyz":
        done = command("calibrate", "sphere", str(out), "-o", str(folder), "--json")
        if done.code:
            return f"refused: {done.refusal}"
        T = np.array(json.loads(done.said[done.said.index("{") : done.said.rindex("}") + 1])["hand_eye"])
        return f"{np.linalg.norm(T[:3, 3] - T_CASES[:3, 3]):.3f} mm off"
    done = command("run", str(out), "-o", str(folder), "--no-recording")
    if done.code:
        return f"run refused: {done.refusal}"
    result = json.loads((folder / "result.json").read_text())
    scale = np.repeat([1.0, MM[result["length_unit"]]], 3)
    T = np.array(result["hand_eye"])
    T[:3, 3] *= scale[3]
    sigma = np.array([np.nan if x is None else x for x in result["hand_eye_sigma"]]) * scale
    off = np.abs(frames.log((frames.inverse(T_CASES[None]) @ T)[0])) / (2 * sigma)
    unknown, left = result["hand_eye_unknown"], len(result["left_out"])
    known = off[:3] if {"x", "y", "z"} <= set(unknown) else off
    words = f"; not known: {', '.join(unknown)}" if unknown else ""
    words += f"; {left} left out" if left else ""
    if name in NO_TRUE_HAND_EYE:
        return f"{result['residual_rms'] * scale[3]:.3f} mm rms{words}"
    return f"{'right' if (known < 2).all() else 'wrong'}, {known.max():.1f} U off{words}"


def apart(session: SessionData, T_mount: Array) -> float:
    """Return the median distance (mm) of points from planes through their neighbours in the next view."""
    scale = MM[session.length_unit]
    placed = []
    for view in session.views:
        T = np.array(view.T_base_flange)
        T[:3, 3] *= scale
        T = T if session.mount == "eye_in_hand" else frames.inverse(T[None])[0]
        placed.append(frames.transform(T @ T_mount, view.cloud.points * scale))
    off = []
    for points, others in pairwise(placed):
        near = others[cKDTree(others).query(points[::9], k=_NEIGHBOURS)[1]]
        middle = near.mean(axis=1)
        normal = np.linalg.svd(near - middle[:, None])[2][:, 2]
        off.append(np.median(np.abs(np.einsum("ni,ni->n", points[::9] - middle, normal))))
    return float(np.median(off))


def turns(session: SessionData, degrees: Sequence[float]) -> bool:
    """True if the poses turn the part about z by these angles, all in one sense."""
    T = np.array([view.T_base_flange for view in session.views])
    angles = np.degrees(np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0])))
    wanted = np.array(degrees) - degrees[0]
    off = min(np.abs((sign * (angles - angles[0]) - wanted + 180) % 360 - 180).max() for sign in (1, -1))
    return session.mount == "eye_to_hand" and off < 0.01 and np.allclose(T[:, :3, 3], 0)


def kind_jobs(seeds: range) -> Iterator[Row]:
    """Every kind of folder."""
    yield from ({"name": name} for name in KINDS)


def kind_trial(job: Row) -> Row:
    """What becomes of a folder of a kind, and once more after what a refusal asks for."""
    name = job["name"]
    kind = KINDS[name]
    campaign = campaigns(_SEED)["turntable" if kind.turntable else "still" if name == "xyz-alone" else "arm"]
    with TemporaryDirectory() as scratch:
        folder, out = Path(scratch) / name.replace(" ", "-"), Path(scratch) / f"{name}-session"
        folder.mkdir()
        kind.write(folder, campaign)
        first = last = init(folder, out, *kind.flags)
        flags = None
        if first.code and kind.expected and kind.mend and re.search(kind.expected, first.refusal):
            flags = kind.mend(folder)
        if flags is not None:
            last = init(folder, out, *flags)
        if last.code:
            right = kind.expected is not None and re.search(kind.expected, last.refusal)
            verdict = f"{'rightly' if right else 'wrongly'} refused"
        else:
            verdict = kind_verdict(kind, campaign, out)
            verdict = verdict if verdict == "right" or "NOT TOLD" not in last.said else f"guessed, said so: {verdict}"
        asked = first.refusal.partition("; to fix: ")[2] or first.refusal
        return {"verdict": verdict + (" once it is stated" if flags is not None else ""), "asked": asked}


@cache
def campaigns(seed: int) -> dict[str, Campaign]:
    """Return the campaign with joints, one of a part on a turntable, and one of a wrist that never turns."""
    measured = measured_blade(seed, views=10, mount="eye_in_hand", pixels=80, repeatability=(0.0, 0.0))
    with TemporaryDirectory() as scratch:
        write_session(Path(scratch) / "campaign", measured, "campaign")
        session = load_session(Path(scratch) / "campaign")
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
    scale = MM[session.length_unit]
    if kind.turntable:
        angles = np.degrees(np.unwrap(np.arctan2(campaign.T[:, 1, 0], campaign.T[:, 0, 0])))
        return "right" if len(session.views) == len(campaign.T) and turns(session, angles.tolist()) else "wrong"
    middles = np.array([np.median(cloud, axis=0) for cloud in campaign.clouds])
    shown = np.array([np.median(view.cloud.points, axis=0) * scale for view in session.views])
    which = np.linalg.norm(shown[:, None] - middles, axis=2).argmin(axis=1)
    wanted = [i for i in range(len(middles)) if i not in (kind.views or ())]
    T = np.array([view.T_base_flange for view in session.views])
    T[:, :3, 3] *= scale
    size = np.median(np.linalg.norm(shown, axis=1) / np.linalg.norm(middles[which], axis=1))
    if abs(size - 1) > SIZE:
        return f"wrong: clouds {size:.4g} times as large"
    if session.mount != "eye_in_hand" or sorted(which.tolist()) != wanted:
        return f"wrong: {session.mount}, views {sorted(which.tolist())}"
    shift = np.abs(T[:, :3, 3] - campaign.T[which][:, :3, 3]).max()
    turn = frames.angle_between(T, campaign.T[which]).max()
    return "right" if shift < NEAR_MM and turn < kind.near else f"wrong by {shift:.3g} mm, {turn:.2g} rad"


def folder_summary(rows: list[Row]) -> list[str]:
    """What becomes of every folder, and how many are right."""
    called = tomllib.loads(Path(__file__).with_name("field_cases.toml").read_text(encoding="utf-8"))
    good = sum(row["verdict"].startswith(("right", "rightly")) for row in rows)
    lines = [[called.get(r["name"], r["name"]), r["verdict"], re.sub(r"/\S+/", "", r["asked"])] for r in rows]
    table = markdown("folder | what becomes of it | what a refusal asks for", lines)
    return [*table, "", f"{good} of {len(rows)} right or rightly refused."]


CASES = Table(case_jobs, case_trial, folder_summary, range(1), page="own-data", block="field", settings={"run": False})
FIELD = Table(kind_jobs, kind_trial, folder_summary, range(1))


def drawn_jobs(seeds: range, count: int) -> Iterator[Row]:
    """So many folders of each seed."""
    yield from ({"seed": seed, "number": number} for seed in seeds for number in range(count))


def drawn_trial(job: Row) -> Row:
    """What becomes of a folder, asked and answered."""
    drawn = draw_folder(job["seed"], job["number"])
    campaign = campaigns(1000 * job["seed"] + job["number"] % _CAMPAIGNS)["arm"]
    with TemporaryDirectory() as scratch:
        folder, out = Path(scratch) / "scans", Path(scratch) / "session"
        folder.mkdir()
        truth = drawn.write(folder, campaign)
        outcome, asked, told, guesses = answered(folder, out, truth, campaign.clouds)
    usual = [guess.what for guess in guesses if guess.because == "usual"]
    marked = sum(what in ("rotation", "pairing", "columns") for what in usual)
    unmarked = len(guesses) - len(usual)
    drawing = {"format": drawn.format, "mistake": drawn.mistake, "inverse": drawn.inverse}
    drawing |= {"units": f"{drawn.unit}/{drawn.cloud_unit}", "named": drawn.named}
    counts = {"marked": marked, "unmarked": unmarked}
    return drawing | counts | {"outcome": outcome, "asked": asked, "told": told[:300]}


def answered(
    folder: Path, out: Path, truth: Truth, clouds: tuple[np.ndarray, ...]
) -> tuple[str, list[str], str, tuple[Guess, ...]]:
    """Return what becomes of a folder that is answered, what it asked, its last refusal, and the guesses."""
    options: dict[str, str] = {}
    asked: list[str] = []
    told = ""
    for _ in range(_STEPS):
        try:
            made = make_session(folder, out, options, guess=bool(asked), force=True)
            return drawn_verdict(load_session(out), made, truth, clouds), asked, told, made.guesses
        except InputError as refused:
            told = refused.what.replace(str(folder), "scans")
            answer = answer_of(refused, truth, options)
        if answer is None:
            known = truth.cause and re.search(truth.cause, told)
            return "refused, true cause" if known else "refused", asked, told, ()
        options |= answer
        asked += answer
    return "circle", asked, told, ()


def answer_of(refused: InputError, truth: Truth, given: dict[str, str]) -> dict[str, str] | None:
    """Return one answer of a person who knows the cell, of the options that a refusal carries; None where none is."""
    for fix in refused.fixes if isinstance(refused, Refusal) else ():
        for name, value in fix.options.items():
            known = truth.answers.get(name)
            if known is not None and given.get(name) != known and (value.isupper() or name != "rows"):
                return {name: known}
        if fix.options.keys() == {"poses"} and re.search(truth.answers.get("file", "$^"), fix.options["poses"]):
            return dict(fix.options)
    return None


def drawn_verdict(session: SessionData, made: Made, truth: Truth, clouds: tuple[np.ndarray, ...]) -> str:
    """Judge a session by the campaign: right, or what is wrong and whether it bears a mark."""
    marks = {guess.what for guess in made.guesses if guess.because == "usual"}
    which = [truth.names.index(Path(view.name).name.split("clouds-")[-1]) for view in session.views]
    T = np.array([view.T_base_flange for view in session.views])
    T[:, :3, 3] *= MM[session.length_unit]
    wrong: dict[str, tuple[str, ...]] = {}
    if sorted(which) != list(truth.views):
        wrong["views"] = ("pairing",)
    if session.mount != "eye_in_hand":
        wrong["mount"] = ("mount",)
    size = [
        np.median(np.linalg.norm(v.cloud.points, axis=1)) * MM[session.length_unit]
        / np.median(np.linalg.norm(clouds[i], axis=1))
        for i, v in zip(which, session.views, strict=True)
    ]  # fmt: skip
    if abs(np.median(size) - 1) > SIZE:
        wrong["cloud unit"] = ("cloud_unit",)
    elif np.abs(np.array(size) - 1).max() > SIZE:
        wrong["one scan's unit"] = ()
    p, true = T[:, :3, 3], truth.T[which][:, :3, 3]
    scale = float(np.sum(p * true) / np.sum(true * true)) if "mount" not in wrong else 1.0
    if abs(scale - 1) > SIZE:
        wrong["unit"] = ("length_unit",)
    turned = frames.angle_between(T, truth.T[which]).max()
    if "mount" not in wrong and (turned > NEAR_RAD or np.abs(p - scale * true).max() > NEAR_MM * max(scale, 1)):
        wrong["poses"] = ("rotation", "pairing", "columns")
    if not wrong:
        return "right"
    silent = [what for what, guesses in wrong.items() if not marks & {*guesses}]
    return f"silently wrong: {', '.join(silent)}" if silent else f"wrong as marked: {', '.join(wrong)}"


def drawn_summary(rows: list[Row]) -> list[str]:
    """Counts of what became of the folders, of all and by mistake."""
    shown = [
        (
            "right, or refused with the true cause, after one answer at most",
            lambda r: _is_fine(r) and len(r["asked"]) < 2,
        ),
        ("right without a question", lambda r: _is_fine(r) and not r["asked"]),
        ("silently wrong", lambda r: r["outcome"].startswith("silently")),
        ("wrong, and marked as a guess", lambda r: r["outcome"].startswith("wrong as")),
        ("refused for another cause than the true one, or without a way on", lambda r: r["outcome"] == "refused"),
        ("round in a circle", lambda r: r["outcome"] == "circle"),
    ]
    lines = [[words, share(holds(row) for row in rows)] for words, holds in shown]
    silent = sum(row["outcome"].count(",") + 1 for row in rows if row["outcome"].startswith("silently"))
    lines.append(["guesses without a mark that are wrong", f"{silent}/{sum(row['unmarked'] for row in rows)}"])
    right = [row for row in rows if row["outcome"] == "right"]
    lines.append(
        ["right ones whose rotation, pairing and columns bear no mark", share(not row["marked"] for row in right)]
    )
    kinds = [
        [mistake or "none", share(_is_fine(r) and len(r["asked"]) < 2 for r in group), _listed(group)]
        for mistake, group in sorted(grouped(rows, "mistake").items())
    ]
    return [*markdown("of the folders | share", lines), "", *markdown("mistake | right | otherwise", kinds)]


def _is_fine(row: Row) -> bool:
    return row["outcome"] in ("right", "refused, true cause")


def _listed(rows: list[Row]) -> str:
    counts = Counter(row["outcome"] for row in rows if not _is_fine(row))
    return ", ".join(f"{n} {outcome}" for outcome, n in counts.most_common())


DRAWN = Table(drawn_jobs, drawn_trial, drawn_summary, range(1), page="own-data", block="drawn", settings={"count": 300})

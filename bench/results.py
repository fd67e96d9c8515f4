"""The first tables of docs/results.md: every row of the five sources and of the main line, each run by its command.

Run: python bench/results.py [--only 001 …]

Commands of `stitch` run in an empty folder, on the simulator's cells and on examples/. Rows of many cells belong to
the scripts that are named; their figures are read from the pages that these scripts write.
"""

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from stitch.numerics import frames

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results.md"
BEGIN, END = "<!-- systems: begin -->", "<!-- systems: end -->"


class Room:
    """An empty folder in which commands run once, with what they print as JSON and the truths beside the cells."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.printed: dict[str, str] = {}
        (folder / "examples").symlink_to(ROOT / "examples")

    def run(self, command: str) -> str:
        """What a command prints, standard output first."""
        if command not in self.printed:
            programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
            environment = {**os.environ, "PATH": programs, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
            call, here = shlex.split(command), ROOT if "pytest" in command else self.folder
            done = subprocess.run(call, cwd=here, env=environment, check=False, capture_output=True, text=True)
            self.printed[command] = done.stdout or done.stderr
            print(f"{done.returncode} {command}", file=sys.stderr)
        return self.printed[command]

    def json(self, command: str) -> Any:
        return json.loads(self.run(command))

    def read(self, file: str) -> Any:
        return json.loads((self.folder / file).read_text(encoding="utf-8"))

    @cached_property
    def blade(self) -> dict[str, Any]:
        return self.read("blade-run/result.json")


@dataclass(frozen=True)
class Row:
    """One line of the table; the last command is the one whose figure is shown."""

    what: str
    commands: tuple[str, ...]
    published: str
    reached: Callable[[Room], str]


def of_page(page: str, pattern: str) -> str:
    """Figures of a page's table, by a pattern with one group."""
    found = re.search(pattern, (ROOT / "docs" / page).read_text(encoding="utf-8"))
    if found is None:
        raise SystemExit(f"docs/{page}: no row {pattern}; run the script that writes it")
    return found.group(1).strip()


def off(T: Any, true: Any) -> tuple[float, float]:
    """Angle (rad) and distance between two poses."""
    T, true = np.array(T), np.array(true)
    return float(frames.angle_between(T, true)), float(np.linalg.norm(T[:3, 3] - true[:3, 3]))


# The main line and source 004: a blade on the flange before a fixed scanner.


def blade_steps(room: Room) -> str:
    coarse, correct, register, fuse = (1e3 * stage["rms"] for stage in room.blade["stages"])
    return f"coarse {coarse:.0f} µm, correct {correct:.0f} µm, register {register:.0f} µm, fuse {fuse:.0f} µm"


def blade_disagreement(room: Room) -> str:
    return f"{1e3 * room.blade['disagreement']['steps'][-1]['mean']:.1f} µm between views on average over the part"


def blade_hand_eye(room: Room) -> str:
    told = room.json("stitch reveal blade-run blade.truth.json --json")
    return f"{1e3 * told['hand_eye_error_coarse_mm']:.0f} µm before, {1e3 * told['hand_eye_error_mm']:.0f} µm after"


def hidden_found(room: Room) -> str:
    told = room.json("stitch reveal hidden-run hidden.truth.json --json")
    before, after = (room.read(f"{run}/result.json") for run in ("hidden-before", "hidden-run"))
    return (
        f"named {', '.join(told['in_the_model'] or told['named'])}; held-out {1e3 * before['heldout_rms']:.0f} → "
        f"{1e3 * after['heldout_rms']:.0f} µm"
    )


BLADE = ("stitch synth blade blade --seed 3", "stitch run blade -o blade-run")
HIDDEN = (
    "stitch synth blade hidden --seed 3 --views 12 --hide backlash=2",
    "stitch run hidden -o hidden-before",
    "stitch run hidden -o hidden-run",
    "stitch add hidden-run --suggested",
)
LINE = (
    "stitch synth window-sweeps line --seed 3",
    "stitch calibrate sphere line/sphere -o line/hand-eye.json",
    "stitch fit line/window.toml -o line/found-window",
    "stitch fit line/body.toml -o line/found-body",
    "stitch seam line/seam.toml --json",
)
DRILL = ("stitch synth drilling drilling --seed 3", "stitch drill drilling/job.toml --json")
PANEL = ("stitch synth panel-robots panel --seed 3", "stitch panel panel/job.toml --json")
MACHINES = "python -m data_synth.cells.panel_job panel moves/shape_move.csv"
SHAPED = f"stitch panel panel/job.toml -o moves --json --drive '{MACHINES}'"
PLACE = "stitch export line/found-body --program line/place.src -o line/there.src --frame 0,0,0,0,0,0 --json"


# Source 003: window and body.


def sphere_hand_eye(room: Room) -> str:
    angle, shift = off(room.read("line/hand-eye.json")["hand_eye"], room.read("line.truth.json")["hand_eye"])
    return f"off by {shift:.3f} mm and {np.degrees(angle):.4f}°"


def fitted(part: str) -> Callable[[Room], str]:
    def reached(room: Room) -> str:
        found = room.read(f"line/found-{part}/fit.json")["parts"][0]
        _, shift = off(found["T_base_part"], room.read("line.truth.json")[f"T_cell_{part}"])
        return f"rms {found['rms']:.3f} mm; pose off by {shift:.3f} mm"

    return reached


def program(room: Room) -> str:
    moved = [target["moved_mm"] for target in room.json(PLACE)["targets"]]
    return f"{len(moved)} targets moved by up to {max(moved):.2f} mm, to the found body"


def seam(room: Room) -> str:
    stations = room.json(LINE[-1])
    flush, gap = (np.array([s[key] for s in stations]) for key in ("flush", "gap"))
    good = sum(s["verdict"] == "good" for s in stations)
    return f"{good} of {len(stations)} good; flush {np.abs(flush).max():.2f}, gap {gap.min():.2f} to {gap.max():.2f} mm"


def each_gap(room: Room) -> str:
    return ", ".join(f"D{s['station']} {s['gap']:.2f}" for s in room.json(LINE[-1])) + " mm"


# Source 001: base to base.


def base_of_experiment_1(room: Room, job: str = "base_to_base") -> str:
    found = room.json(f"stitch base examples/{job}.toml --json")
    truth = frames.exp(np.array([0, 0, -np.pi / 2, 0, 0, 0]))
    truth[:3, 3] = [4.0, -1.0, 1.0]
    parts = []
    for name, T in (("least squares", found["T_base1_base2"]), ("projection", found["projection"]["T_base1_base2"])):
        angle, shift = off(T, truth)
        parts.append(f"{name} {angle:.5f} rad, {shift:.5f} m")
    return "; ".join(parts)


def other_planes(room: Room) -> str:
    found = room.json("stitch base examples/base_to_base_rpy.toml --json")["projection"]
    _, (px, pz), (py, pz2) = found["offsets"]
    beta, alpha = found["flange_beta_alpha"]
    open_planes = sum("open" in plane for plane in found["likewise"].values())
    return (
        f"px {px:.4f}, pz {pz:.4f}; py {py:.4f}, pz {pz2:.4f}; the cosine rules are 0/0 in {open_planes} of 2 planes; "
        f"by the flanges β {beta:.5f}, α {alpha:.5f}"
    )


def flange_of_p1(room: Room) -> str:
    alpha, _, gamma = room.json("stitch base examples/base_to_base_joints.toml --json")["flange_rpy"]["P1"]
    return f"P1 α {alpha:.4f}, γ {gamma:.4f}"


def base_of_experiment_2(room: Room) -> str:
    said = " ".join(room.run("stitch base examples/base_to_base_2.toml").split())
    return f"refused: rod and joints differ by {re.search(r'difference of [+]?([-0-9.]+) m', said).group(1)} m"


# Source 002: fuselage panel.


def panel_model(room: Room) -> str:
    robots = room.json(PANEL[-1])["robots"].values()
    base, turn = (max(max(r[key]) for r in robots) for key in ("sigma_base", "sigma_base_deg"))
    return f"bases within ± {base:.3f} mm, {turn:.4f}° (1 σ)"


def panel_leg(room: Room) -> str:
    hidden, legs = room.read("panel.truth.json")["hidden"], room.json(PANEL[-1])["leg_offsets"]
    found = {f"{name}{leg['leg']}": leg["offset"] for name, leg in legs.items() if leg["found"]}
    told = ", ".join(f"{name} {size:+.2f} mm" for name, size in found.items()) or "none"
    return f"hidden {hidden['robot']}{hidden['leg']} {hidden['offset']:+.2f} mm; found {told}"


def panel_shape(room: Room) -> str:
    largest = room.json(SHAPED)["corrections"]["largest_deviation"]
    return f"{' → '.join(f'{size:.2f}' for size in largest)} mm in {len(largest) - 1} corrections"


# Source 000: drilling.


def drill_errors(room: Room) -> str:
    truth, found = room.read("drilling.truth.json")["holes"], room.json(DRILL[-1])
    places, angles = [], []
    for drive in found["drives"]:
        hole = truth[drive["hole"]]
        places.append(np.linalg.norm(np.subtract(drive["position"], hole["position"])))
        angles.append(np.degrees(np.arccos(np.clip(np.dot(drive["direction"], hole["direction"]), -1, 1))))
    return f"position ≤ {max(places):.2f} mm, direction ≤ {max(angles):.2f}°"


def drill_before(room: Room) -> str:
    errors = [e for group in room.json(DRILL[-1])["groups"].values() for e in group["drive_errors"]]
    return f"{min(errors):.2f} to {max(errors):.2f} mm, mean {np.mean(errors):.2f}"


def trials(stage: str, what: str, unit: str) -> Callable[[Room], str]:
    def reached(room: Room) -> str:
        values = [t[what] for t in room.json(DRILL[-1])["trials"] if t["stage"] == stage]
        return f"{min(values):.2f} to {max(values):.2f} {unit}, mean {np.mean(values):.2f}"

    return reached


def pin(room: Room) -> str:
    bounds = [(t["pin_position"], t["pin_tilt_deg"]) for t in room.json(DRILL[-1])["trials"] if t["pin_position"]]
    position, tilt = np.max(bounds, axis=0)
    return f"≤ {position:.2f} mm, ≤ {tilt:.2f}°"


def plate(room: Room) -> str:
    found = room.json(DRILL[-1])["plate"]
    return f"h {found['height']:.2f} mm, {found['stated']:.2f} stated; parallel within {found['parallelism']:.2f} mm"


def drill_camera(room: Room) -> str:
    truth = room.read("drilling.truth.json")["hidden"]
    named = {t["effect"]: t["value"] for t in room.json(DRILL[-1])["camera_effects"] if t["accepted"]}
    return "; ".join(f"{name} {named.get(name, 0):.3g}, hidden {size:.3g}" for name, size in truth.items())


# What the user named by name.


def recording(room: Room) -> str:
    told = room.run("rerun rrd verify blade-run/recording.rrd").strip().splitlines()[-1]
    return f"{(room.folder / 'blade-run/recording.rrd').stat().st_size / 1e6:.1f} MB; {told}"


def batch(room: Room) -> str:
    room.run(BATCH)
    runs = list(room.folder.glob("runs/*/result.json"))
    return f"{len(runs)} of 2 sessions have a run"


def mesh_tests(room: Room) -> str:
    return re.search(r"[^\n]*(passed|skipped|failed)[^\n]* in", room.run(MESHES) + " in").group(0).removesuffix(" in")


BATCH = "stitch batch blade hidden -o runs --json --no-recording"
MESHES = "python -m pytest -n 0 -m '' tests/data_synth/test_real_meshes.py"

SYSTEMS: dict[str, tuple[Row, ...]] = {
    "Main line: scans, hand-eye, what is missing": (
        Row("each stage's distance between surfaces", BLADE, "steps are visible with the coarse hand-eye", blade_steps),
        Row("hand-eye, error at the part", (*BLADE, "stitch reveal blade-run blade.truth.json"), "–", blade_hand_eye),
        Row("a hidden effect named and added", HIDDEN, "–", hidden_found),
    ),
    "004: blade stitched by hand-eye correction": (
        Row("agreement of the stitched cloud", BLADE, "better than 100 µm", blade_disagreement),
        Row(
            "DPWVM against GICP, error of the view poses",
            ("python bench/register_weights.py",),
            "DPWVM named without a formula",
            lambda _: of_page("register.md", r"\| DPWVM-style \|(?:[^|]*\|){5}([^|]*)\|") + " cell by cell",
        ),
        Row(
            "the same with stock on one view",
            ("python bench/register_weights.py",),
            "–",
            lambda _: (
                of_page("register.md", r"\| DPWVM-style \|(?:[^|]*\|){4}([^|]*)\|")
                + " µm, GICP "
                + of_page("register.md", r"\| GICP inside Tukey \|(?:[^|]*\|){4}([^|]*)\|")
                + " µm"
            ),
        ),
    ),
    "003: window and car body": (
        Row("hand-eye from a sphere", LINE[:2], "X 926.866, Y 652.648, Z 934.441 mm; no truth", sphere_hand_eye),
        Row("body onto its CAD", (*LINE[:2], LINE[3]), "fit error 1.052", fitted("body")),
        Row("window onto its CAD", LINE[:3], "fit error 0.573", fitted("window")),
        Row("path corrected for the found body, as the robot's program", (*LINE[:2], LINE[3], PLACE), "–", program),
        Row("flush and gap at eight places", LINE, "flush 0 ± 1.5, gap 16 ± 2 mm", seam),
        Row("table 1: gap width at D1 to D8", LINE, "figures lost; all within 16 ± 2 mm", each_gap),
        Row(
            "the whole line, 5 cells: window set against its design place",
            ("python bench/window_line.py",),
            "–",
            lambda _: of_page("window.md", r"\| all together \|(?:[^|]*\|){3}([^|]*)\|") + " mm (rms, largest)",
        ),
    ),
    "001: base to base": (
        Row(
            "experiment 1 as printed",
            ("stitch base examples/base_to_base.toml",),
            "0.00010 rad, 0.00014 m at λ = 0.1",
            base_of_experiment_1,
        ),
        Row(
            "the same by joint angles, 6R and SCARA",
            ("stitch base examples/base_to_base_joints.toml",),
            "table 3: P1 α −3.1415, γ 0.6283",
            flange_of_p1,
        ),
        Row(
            "experiment 2 as printed",
            ("stitch base examples/base_to_base_2.toml",),
            "0.00014 rad, 0.00014 m at λ = 0.1",
            base_of_experiment_2,
        ),
        Row(
            "experiment 1 with flange angles, table 3 at λ = 0.5",
            ("stitch base examples/base_to_base_rpy.toml",),
            "0.00017 rad, 0.00022 m",
            lambda room: base_of_experiment_1(room, "base_to_base_rpy"),
        ),
        Row(
            "table 4 at λ = 0.5: X-Z and Y-Z planes",
            ("stitch base examples/base_to_base_rpy.toml",),
            "px 4.0000, pz 1.0002, β 0.0001; py −1.0000, pz 1.0001, α 0.0001",
            other_planes,
        ),
        *(
            Row(
                f"experiment {n}, λ = 0.5, 1000 draws, {what}: rms; 95 % between, µrad / µm",
                ("python bench/base_to_base.py",),
                f"{published}, one draw",
                lambda _, n=n, what=what: (
                    of_page("base-to-base.md", rf"\| {n} \| 0.5 \| {what} \|((?:[^|]*\|){{3}})")
                    .replace("|", ";", 1)
                    .split(";")[0]
                    + "; "
                    + of_page("base-to-base.md", rf"\| {n} \| 0.5 \| {what} \|(?:[^|]*\|){{2}}([^|]*)\|")
                ),
            )
            for n, published in ((1, "170 / 220"), (2, "540 / 360"))
            for what in ("projection", "least squares")
        ),
    ),
    "002: fuselage panel": (
        Row("global model of robots and tracker", PANEL, "–", panel_model),
        Row("a leg that is too long or short", PANEL, "–", panel_leg),
        Row(
            "pose after one adjustment, 30 cells, largest: x, y, z / mm",
            ("python bench/panel.py",),
            "0.047, 0.069, 0.036 mm; 0.008°",
            lambda _: of_page("panel.md", r"\| after, largest \|((?:[^|]*\|){3})").replace(" |", ",").strip(" ,|"),
        ),
        Row("shape, one command", (*PANEL[:1], SHAPED), "≤ 0.6 mm", panel_shape),
        Row(
            "shape, 10 cells, largest deviation after one correction",
            ("python bench/panel.py",),
            "≤ 0.6 mm",
            lambda _: of_page("panel.md", r"the rest gives way \|[^|]*\|([^|]*)\|") + " mm",
        ),
    ),
    "000: drilling on curved structures": (
        Row("plate against the flange", DRILL, "h 186.61 mm, 186.60 measured; parallel within 0.11 mm", plate),
        Row("reference holes by the drawing", DRILL, "–", drill_before),
        Row("table 4: by the drawing, 3D", DRILL, "2.28 to 2.85 mm, mean 2.55", trials("drawing", "distance", "mm")),
        Row("table 4: 2D", DRILL, "0.61 to 2.00 mm, mean 1.32", trials("drawing", "in_plane", "mm")),
        Row("table 4: direction", DRILL, "2.09 to 3.93°, mean 3.30", trials("drawing", "tilt_deg", "°")),
        Row("table 6: corrected and levelled, 2D", DRILL, "0.03 to 0.15 mm", trials("levelled", "in_plane", "mm")),
        Row("table 7: a pin went in", DRILL, "≤ 0.30 mm, ≤ 0.21°", pin),
        Row("drilled holes, after", DRILL, "position ≤ 0.30 mm, direction ≤ 0.21°", drill_errors),
        Row("what the homography hides", DRILL, "lens distortion neglected", drill_camera),
        Row(
            "drilled holes after, 200 cells: largest position / mm",
            ("python bench/drilling.py",),
            "≤ 0.30 mm",
            lambda _: of_page("drilling.md", r"\| after \| position 3D / mm \|(?:[^|]*\|){2}([^|]*)\|"),
        ),
    ),
}


SYSTEMS["Named programs and libraries"] = (
    Row(
        "KISS-ICP on a scanner that never stops: right motions",
        ("python -m bench.odometry --write",),
        "–",
        lambda _: of_page("session.md", r"odometry from the stated hand-eye \|[^|]*\|([^|]*)\|"),
    ),
    Row(
        "hand-eye from it, and from the whole run on the same scans, off by / mm",
        ("python -m bench.odometry --write",),
        "–",
        lambda _: ", ".join(
            of_page("session.md", rf"\| `{name} \|[^|]*\|[^|]*\|([^|]*)\|")
            for name in ("moving-scan`, odometry from the stated hand-eye", "moving-scan`, the whole run")
        ),
    ),
    Row("Rerun: every stage and iteration", (*BLADE, "rerun rrd verify blade-run/recording.rrd"), "–", recording),
    Row("real meshes, watertight and broken, from scan to fit", (MESHES,), "–", mesh_tests),
    Row("many sessions by one command", (BLADE[0], HIDDEN[0], BATCH), "–", batch),
)


def lines(room: Room, only: list[str]) -> dict[str, list[str]]:
    """The tables, a block of rows for each system whose name begins with one of `only`."""
    blocks = {}
    for system, rows in SYSTEMS.items():
        if only and not system.startswith(tuple(only)):
            continue
        out = [f"### {system}", "", "| what | command | published | reached |", "|---|---|---|---|"]
        for row in rows:
            for command in row.commands:
                if command.startswith("stitch"):
                    room.run(command)
            out.append(f"| {row.what} | `{row.commands[-1]}` | {row.published} | {row.reached(room)} |")
        prepared = [c for row in rows for c in row.commands[:-1]]
        if prepared:
            out += ["", "Before these commands:", "", "```sh", *dict.fromkeys(prepared), "```"]
        blocks[system] = [*out, ""]
    return blocks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[], help="how names of systems begin; the other tables stay")
    with tempfile.TemporaryDirectory() as folder:
        blocks = lines(Room(Path(folder)), parser.parse_args().only)
    page = PAGE.read_text(encoding="utf-8")
    head, tail = page.split(BEGIN)[0], page.split(END)[1]
    told = re.split(r"^### ", page.split(BEGIN)[1].split(END)[0], flags=re.MULTILINE)[1:]
    kept = {block.split("\n")[0]: [*f"### {block}".rstrip("\n").split("\n"), ""] for block in told}
    table = [line for system in SYSTEMS for line in blocks.get(system, kept.get(system, []))]
    PAGE.write_text("\n".join([head + BEGIN, "", *table]) + END + tail, encoding="utf-8")


if __name__ == "__main__":
    main()

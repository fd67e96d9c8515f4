"""The first tables of docs/results.md: every row of the five sources and of the main line, each run by its command.

Commands of `stitch` run in an empty folder, on the simulator's cells and on examples/. The rows stand in results.toml;
figures of many cells are read from the pages into which other tables are written. `--only 001` makes one system alone.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness import DOCS, ROOT, Row, Table, grouped, markdown
from bench.speed import part_from_reference, points_of
from data_synth.fixtures.part_distance import off_surface
from data_synth.fixtures.quiet_scenes import mesh_of
from stitch.numerics import frames

ROWS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


class Room:
    """An empty folder in which commands run once, with what they print as JSON and the truths beside the cells.

    A function of a row's figure takes the room and the row's last command.
    """

    def __init__(self) -> None:
        self.kept = tempfile.TemporaryDirectory()
        self.folder = Path(self.kept.name)
        self.printed: dict[str, str] = {}
        (self.folder / "examples").symlink_to(ROOT / "examples")

    def run(self, command: str) -> str:
        """What a command prints, standard output first."""
        if command not in self.printed:
            programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
            paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
            environment = os.environ | {"PATH": programs, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
            call, here = shlex.split(command), ROOT if "pytest" in command else self.folder
            done = subprocess.run(call, cwd=here, env=environment, check=False, capture_output=True, text=True)
            self.printed[command] = done.stdout or done.stderr
            print(f"{done.returncode} {command}", file=sys.stderr)
        return self.printed[command]

    def json(self, command: str) -> Any:
        return json.loads(self.run(command))

    def read(self, file: str) -> Any:
        return json.loads((self.folder / file).read_text(encoding="utf-8"))

    def blade_steps(self, command: str) -> str:
        stages = self.read("blade-run/result.json")["stages"]
        return ", ".join(f"{stage['name']} {1e3 * stage['rms']:.0f} µm" for stage in stages)

    def blade_disagreement(self, command: str) -> str:
        steps = self.read("blade-run/result.json")["disagreement"]["steps"]
        return f"{1e3 * steps[-1]['mean']:.1f} µm between views on average over the part"

    def blade_off_part(self, command: str) -> str:
        self.run(command)
        session, run, truth = (self.folder / name for name in ("blade", "blade-run", "blade.truth.json"))
        views = json.loads((run / "result.json").read_text(encoding="utf-8"))["views"]
        clouds = [points_of(session / "clouds" / f"{view['view']}.ply") for view in views]
        T = part_from_reference(clouds, np.array([view["pose"] for view in views]), json.loads(truth.read_text()))
        off = np.abs(off_surface(mesh_of("blade"), frames.transform(T, points_of(run / "stitched.ply")))[0])
        median, most = 1e3 * np.quantile(off, (0.5, 0.95))
        return f"half of its points within {median:.0f} µm of the true part, 95 % within {most:.0f} µm"

    def blade_hand_eye(self, command: str) -> str:
        revealed = self.json(f"{command} --json")
        before, after = (1e3 * revealed[f"hand_eye_error{name}_mm"] for name in ("_coarse", ""))
        return f"{before:.0f} µm before, {after:.0f} µm after"

    def hidden_found(self, command: str) -> str:
        revealed = self.json("stitch reveal hidden-run hidden.truth.json --json")
        runs = (self.read(f"{run}/result.json") for run in ("hidden-before", "hidden-run"))
        before, after = (1e3 * run["heldout_rms"] for run in runs)
        named = ", ".join(revealed["in_the_model"] or revealed["named"])
        return f"named {named}; held-out {before:.0f} → {after:.0f} µm"

    def sphere_hand_eye(self, command: str) -> str:
        angle, shift = off(self.read("line/hand-eye.json")["hand_eye"], self.read("line.truth.json")["hand_eye"])
        return f"off by {shift:.3f} mm and {np.degrees(angle):.4f}°"

    def fitted(self, command: str, part: str) -> str:
        fit = self.read(f"line/found-{part}/fit.json")["parts"][0]
        _, shift = off(fit["T_base_part"], self.read("line.truth.json")[f"T_cell_{part}"])
        return f"rms {fit['rms']:.3f} mm; pose off by {shift:.3f} mm"

    def program(self, command: str) -> str:
        moved = [target["moved_mm"] for target in self.json(command)["targets"]]
        return f"{len(moved)} targets moved by up to {max(moved):.2f} mm, to the found body"

    def seam(self, command: str) -> str:
        stations = self.json(command)
        flush, gap = (np.array([s[key] for s in stations]) for key in ("flush", "gap"))
        good = sum(s["verdict"] == "good" for s in stations)
        sizes = f"flush {np.abs(flush).max():.2f}, gap {gap.min():.2f} to {gap.max():.2f} mm"
        return f"{good} of {len(stations)} good; {sizes}"

    def each_gap(self, command: str) -> str:
        return ", ".join(f"D{s['station']} {s['gap']:.2f}" for s in self.json(command)) + " mm"

    def base_of_experiment_1(self, command: str) -> str:
        solved = self.json(f"{command} --json")
        truth = frames.exp(np.array([0, 0, -np.pi / 2, 0, 0, 0]))
        truth[:3, 3] = [4.0, -1.0, 1.0]
        least_squares, projection = (off(by["T_base1_base2"], truth) for by in (solved, solved["projection"]))
        return "least squares {:.5f} rad, {:.5f} m; projection {:.5f} rad, {:.5f} m".format(*least_squares, *projection)

    def other_planes(self, command: str) -> str:
        projection = self.json(f"{command} --json")["projection"]
        _, (px, pz), (py, pz2) = projection["offsets"]
        beta, alpha = projection["flange_beta_alpha"]
        return (
            f"px {px:.4f}, pz {pz:.4f}; py {py:.4f}, pz {pz2:.4f}; the source's cosine "
            f"rules are 0/0 in both; by the flanges β {beta:.5f}, α {alpha:.5f}"
        )

    def flange_of_p1(self, command: str) -> str:
        alpha, _, gamma = self.json(f"{command} --json")["flange_rpy"]["P1"]
        return f"P1 α {alpha:.4f}, γ {gamma:.4f}"

    def base_of_experiment_2(self, command: str) -> str:
        text = " ".join(self.run(command).split())
        return f"refused: rod and joints differ by {re.search(r'difference of [+]?([-0-9.]+) m', text)[1]} m"

    def panel_model(self, command: str) -> str:
        robots = self.json(command)["robots"].values()
        base, turn = (max(max(r[key]) for r in robots) for key in ("sigma_base", "sigma_base_deg"))
        return f"bases within ± {base:.3f} mm, {turn:.4f}° (1 σ)"

    def panel_leg(self, command: str) -> str:
        hidden, legs = self.read("panel.truth.json")["hidden"], self.json(command)["leg_offsets"]
        named = [f"{name}{leg['leg']} {leg['offset']:+.2f} mm" for name, leg in legs.items() if leg["found"]]
        true = f"{hidden['robot']}{hidden['leg']} {hidden['offset']:+.2f} mm"
        return f"hidden {true}; found {', '.join(named) or 'none'}"

    def panel_shape(self, command: str) -> str:
        largest = self.json(command)["corrections"]["largest_deviation"]
        return f"{' → '.join(f'{size:.2f}' for size in largest)} mm in {len(largest) - 1} corrections"

    def drill_errors(self, command: str, what: str, text: str) -> str:
        truth, errors = self.read("drilling.truth.json")["holes"], []
        for drive in self.json(command)["drives"]:
            found, true = (np.array(hole[what]) for hole in (drive, truth[drive["hole"]]))
            off = np.linalg.norm(found - true)
            errors.append(off if what == "position" else np.degrees(np.arccos(np.clip(found @ true, -1, 1))))
        return text.format(max(errors))

    def drill_before(self, command: str) -> str:
        return _range([e for group in self.json(command)["groups"].values() for e in group["drive_errors"]], "mm")

    def trials(self, command: str, stage: str, what: str, unit: str) -> str:
        return _range([t[what] for t in self.json(command)["trials"] if t["stage"] == stage], unit)

    def pin(self, command: str) -> str:
        trials = [t for t in self.json(command)["trials"] if t["pin_position"]]
        position, tilt = np.max([(t["pin_position"], t["pin_tilt_deg"]) for t in trials], axis=0)
        return f"≤ {position:.2f} mm, ≤ {tilt:.2f}°"

    def plate(self, command: str) -> str:
        plate = self.json(command)["plate"]
        return "h {height:.2f} mm, {stated:.2f} stated; parallel within {parallelism:.2f} mm".format(**plate)

    def drill_camera(self, command: str) -> str:
        truth = self.read("drilling.truth.json")["hidden"]
        named = {t["effect"]: t["value"] for t in self.json(command)["camera_effects"] if t["accepted"]}
        return "; ".join(f"{name} {named.get(name, 0):.3g}, hidden {size:.3g}" for name, size in truth.items())

    def recording(self, command: str) -> str:
        size = (self.folder / "blade-run/recording.rrd").stat().st_size / 1e6
        return f"{size:.1f} MB; {self.run(command).strip().splitlines()[-1]}"

    def batch(self, command: str) -> str:
        self.run(command)
        return f"{len(list(self.folder.glob('runs/*/result.json')))} of 2 sessions have a run"

    def mesh_tests(self, command: str) -> str:
        return re.search(r"[^\n]*(?:passed|skipped|failed)[^\n]*?(?= in|$)", self.run(command))[0]


def off(T: Any, true: Any) -> tuple[float, float]:
    """Return the angle (rad) and distance between two poses."""
    T, true = np.array(T), np.array(true)
    return float(frames.angle_between(T, true)), float(np.linalg.norm(T[:3, 3] - true[:3, 3]))


def _range(values: list[float], unit: str) -> str:
    return f"{min(values):.2f} to {max(values):.2f} {unit}, mean {np.mean(values):.2f}"


def jobs(seeds: range) -> Iterator[Row]:
    """Every row of every system, in one room."""
    for system, rows in ROWS["systems"].items():
        for what, words, published, figure in rows:
            commands = [command for word in words for command in ROWS["groups"].get(word, [word])]
            row = {"number": system.split(":")[0], "what": what, "commands": commands, "published": published}
            yield {"system": system, **row, "figure": figure}


def trial(job: Row) -> Row:
    """Run the row's commands and read its figure."""
    figure = job["figure"]
    if figure[0].endswith(".md"):
        page, pattern, text = figure
        match = re.search(pattern, (DOCS / page).read_text(encoding="utf-8"))
        if match is None:
            raise SystemExit(f"docs/{page}: no row {pattern}; write the table that has it first")
        return {"reached": text.format(*(group.strip() for group in match.groups()))}
    room = _room()
    for command in job["commands"]:
        if command.startswith("stitch"):
            room.run(command)
    return {"reached": getattr(room, figure[0])(job["commands"][-1], *figure[1:])}


@cache
def _room() -> Room:
    return Room()


def summary(rows: list[Row]) -> list[str]:
    """A table a system, with the commands that have to run before; of systems that were left out, what the page has."""
    text = (DOCS / "results.md").read_text(encoding="utf-8")
    text = text.split("<!-- systems: begin -->")[1].split("<!-- systems: end -->")[0]
    kept = dict(re.findall(r"(?ms)^### ([^\n]*)\n(.*?)(?=^### |\Z)", text))
    lines = []
    for system in ROWS["systems"]:
        group = grouped(rows, "system").get(system)
        lines += [f"### {system}", ""]
        if group is None:
            lines += [*kept.get(system, "").strip().splitlines(), ""]
            continue
        cells = []
        for row in group:
            last = row["commands"][-1]
            shown = f"[{last}]({last})" if last.endswith(".md") else f"`{last}`"
            cells.append([row["what"], shown, row["published"], row["reached"]])
        lines += [*markdown("what | command | published | reached", cells), ""]
        before = dict.fromkeys(command for row in group for command in row["commands"][:-1])
        if before:
            lines += ["Before these commands:", "", "```sh", *before, "```", ""]
    return lines


TABLE = Table(jobs, trial, summary, range(1), page="results", block="systems", one_core=False)

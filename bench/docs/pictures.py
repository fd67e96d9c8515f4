"""Pictures of the pages: python -m bench.docs.pictures scenes|cells|report|architecture [NAME …].

`scenes`: every scene, the part with the scanner where the views are taken. `cells`: figures and pages of the cells,
from the jobs in examples/, and closed loops of panel and door. `report`: page and recording of the demo's cell, as
people see them, light, dark, on a phone, and two runs side by side; or of the run folder that is named. `architecture`:
the rooms of stitch from its import graph; floors come from the import rules in pyproject.toml, arrows from the imports
themselves, so that the picture cannot say what the code does not.

Pages need a Chromium on the path, the recording a software renderer for Rerun (Mesa's Vulkan drivers).
"""

import ast
import io
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
import tomllib
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image

from bench.harness import PICTURES, ROOT
from data_synth import kinematics
from data_synth.picture import render
from data_synth.planning import plan_views
from data_synth.scene import load_scene, names
from data_synth.simulate import part_mesh
from stitch.cli.main import main as stitch
from stitch.cli.report import printing_browser
from stitch.numerics import frames

EXAMPLES = ROOT / "examples"
DRAWN = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--hide-scrollbars")
# Azimuth and elevation of the camera in degrees: where scanners hide least of the part.
CAMERAS = {
    "blade": (75.0, 30.0), "blade-table": (-175.0, 18.0), "car-door": (-118.0, 16.0), "drill-plate": (-50.0, 18.0),
    "line-sweep": (-55.0, 20.0), "panel": (-50.0, 16.0), "spheres": (-60.0, 16.0),
}  # fmt: skip
JOBS = {"base": "base_to_base.toml", "drill": "drilling/job.toml", "panel": "panel/job.toml"}
JOBS |= {"fit": "window/fit.toml", "seam": "window/seam.toml"}
_COLOURS = 96  # enough for shades and a few lines; a third of the bytes
_PAGES = {
    "report-light": (1400, 1040),
    "report-dark": (1400, 1040, "--blink-settings=preferredColorScheme=0"),
    "report-phone": (500, 1500),
}
_PORT, _WINDOW, _TITLE = 9923, "1400x860", 37
_TABS = {"before-after": "Before | after", "cell": "The cell"}
_WIDTH, _HEIGHT, _GAP = 4.6, 0.95, 0.42


def main() -> None:
    """Draw what is asked for."""
    matplotlib.use("agg")
    kinds = {"scenes": scenes, "cells": cells, "report": report, "architecture": architecture}
    kinds[sys.argv[1]](sys.argv[2:])


def scenes(chosen: list[str]) -> None:
    """Planned views, as the controller would drive them."""
    for name in chosen or names():
        scene = load_scene(name)
        mesh = part_mesh(scene)
        plan, rail = plan_views(scene, mesh, scene.plan.views, np.random.default_rng([0, 1]))
        T = kinematics.flange(scene.arm, plan.joints)
        T[:, 0, 3] += rail
        T_reference_scanner = (frames.inverse(T) if scene.mount == "eye_to_hand" else T) @ scene.T_mount
        if scene.mount == "eye_in_hand":
            # As it lies in the cell; a part on a flange has no up, so that one is shown as it was drawn.
            mesh = mesh.copy().apply_transform(scene.T_reference_part)
        else:
            T_reference_scanner = frames.inverse(scene.T_reference_part) @ T_reference_scanner
        path, camera = PICTURES / f"{name}.png", CAMERAS.get(name, (35.0, 20.0))
        seen = {"standoff": scene.scanner.standoff, "field_of_view": scene.scanner.field_of_view}
        render(mesh, path, *camera, size=(900, 600), T_part_scanner=T_reference_scanner, **seen)
        _in_colours(path, _COLOURS)


def _in_colours(path: Path, colours: int) -> None:
    image = Image.open(path).convert("RGB").quantize(colours, dither=Image.Dither.NONE)
    image.save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def cells(chosen: list[str]) -> None:
    """The top of every cell's page, half as large as it is shown, and figures."""
    with tempfile.TemporaryDirectory() as folder:
        for command, job in JOBS.items():
            page = Path(folder) / f"{command}.html"
            call([command, EXAMPLES / job, "--report", page])
            shot(page, 1000, 1000).reduce(2).save(PICTURES / f"cell-{command}.webp", quality=90, method=6)
    for name, (figure, dpi) in _figures().items():
        figure.savefig(PICTURES / f"{name}.png", dpi=dpi)
        print(PICTURES / f"{name}.png")
    _in_colours(PICTURES / "window-map.png", 256)


def _figures() -> dict[str, tuple[Any, int]]:
    """By the picture's name, with its resolution."""
    from bench import panel, window
    from stitch.plugins.cells.base_to_base import read_stand, solve_stand
    from stitch.plugins.cells.drilling import read_drill_job, solve_drill_job
    from stitch.plugins.cells.panel import calibrate_robots, read_panel_job, solve_panel_job
    from stitch.plugins.cells.panel_model import errors_along_motion
    from stitch.plugins.cells.scan_to_cad import measure_deviations
    from stitch.plugins.cells.window import read_seam_job, solve_seam
    from viz.cells import base_to_base, window_seam
    from viz.cells.drilling import holes
    from viz.cells.panel import errors_figure, shape, shape_figure
    from viz.cells.window_fit import deviation_map

    stand, drilling = read_stand(EXAMPLES / "base_to_base.toml"), read_drill_job(EXAMPLES / "drilling" / "job.toml")
    job, seam = read_panel_job(EXAMPLES / "panel" / "job.toml"), read_seam_job(EXAMPLES / "window" / "seam.toml")
    cell, ready = panel.calibrated(0)
    moved = (calibrate_robots(ready)[0], ready.flanges, panel.MASTER)
    shift = errors_along_motion(*moved, np.linspace(0, 100, 11), turn=False)
    turn = errors_along_motion(*moved, np.radians(np.linspace(0, 2, 11)), turn=True)
    cell.lay()
    ready = panel.adjust_panel(cell, ready)
    cell.compliant = True
    largest, measured = panel.correct_shape(cell, ready)
    forces = np.array([np.linalg.norm(f[:, 3:], axis=1).max() for f in measured])
    scan, _, fit = window.fitted_case("door, welding bulge 3 mm, σ 130 mm", 0)
    _, surface = window.part_of("door")
    deviations = measure_deviations(scan, surface, fit.T_base_part, 0.5, surface.size / 60)
    return {
        "base-to-base": (base_to_base.plan(stand, solve_stand(stand)), 95),
        "drilling": (holes(drilling, solve_drill_job(drilling)), 95),
        "panel-clamps": (shape(job, solve_panel_job(job)), 95),
        "window-seam": (window_seam.cuts(seam, solve_seam(seam)), 95),
        "panel-errors": (errors_figure(panel.NAMES, panel.MASTER, shift, turn), 110),
        "panel-shape": (shape_figure(panel.NAMES, largest, panel.TOLERANCE, forces), 110),
        "window-map": (deviation_map(deviations, "mm"), 100),
    }


def call(*commands: list[object]) -> None:
    """Run commands of stitch."""
    for command in commands:
        try:
            stitch([str(word) for word in command])
        except SystemExit as ended:
            if ended.code:
                raise


def report(chosen: list[str]) -> None:
    """Page and recording of the demo's cell, before what is missing is added and after; or of a run folder."""
    with tempfile.TemporaryDirectory() as name:
        run = Path(chosen[0]) if chosen else Path(name) / "before"
        if not chosen:
            demo = Path(name) / "demo"
            call(["demo", demo], ["run", demo / "blade", "-o", run, "--tolerance", "0.05"], ["diagnose", run])
            page = demo / "run" / "two-runs.html"
            call(["report", run, demo / "run", "-o", page])
            keep(shot(page, 1100, 1500), "two-runs")
        for picture, (width, height, *more) in _PAGES.items():
            keep(shot(run / "report.html", width, height, *more), picture)
        recording(run)


def shot(page: Path, width: int, height: int, *more: str) -> Image.Image:
    """The top of a page, so many pixels wide and high."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "shot.png"
        options = [f"--window-size={width},{height}", "--virtual-time-budget=6000", f"--screenshot={file}", *more]
        command = [printing_browser(), "--headless=new", "--no-sandbox", *DRAWN, *options, page.resolve().as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=180)
        return Image.open(file).convert("RGB")


def recording(run: Path) -> None:
    """Tabs of the recording of a run."""
    program = Path(sys.executable).with_name("rerun")
    arguments = [program, run / "recording.rrd", "--headless", "--port", str(_PORT), "--window-size", _WINDOW]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    shown = subprocess.Popen(arguments, **quiet, start_new_session=True)
    try:
        client = _loaded()
        for name, tab in _TABS.items():
            blueprint = client.get_blueprint().blueprint
            for node in blueprint.values():
                tabs = node.get("ContainerBlueprint", {})
                if tabs.get("container_kind") == "Tabs":
                    tabs["active_tab"] = next(
                        child for child in tabs["contents"] if tab in _names(blueprint[f"/{child}"])
                    )
            client.set_blueprint(blueprint, of="recording")
            time.sleep(5)
            picture = Image.open(io.BytesIO(_taken(client)))
            # The window's own bar says what machine took the picture.
            keep(picture.crop((0, _TITLE, *picture.size)), f"recording-{name}")
    finally:
        # The viewer too, which the launcher leaves behind: the next recording would open in it.
        os.killpg(shown.pid, signal.SIGTERM)
        shown.wait()


def _names(node: dict[str, Any]) -> list[str]:
    """What a part of a blueprint is called."""
    return [part["display_name"] for part in node.values() if isinstance(part, dict) and "display_name" in part]


def _taken(client: Any) -> bytes:
    """A picture of what is shown; a viewer that draws on a busy processor may need several tries."""
    for _ in range(5):
        try:
            return bytes(client.take_screenshot())
        except TimeoutError:
            time.sleep(5)
    raise RuntimeError("the viewer gave no picture: is the machine busy?")


def _loaded() -> Any:
    """The viewer, when it has read the whole recording."""
    import rerun.experimental as viewer

    for _ in range(120):
        time.sleep(1)
        try:
            client = viewer.ViewerClient.connect(f"rerun+http://127.0.0.1:{_PORT}/proxy")
            state = client.get_state()
        except ConnectionError:
            continue
        if state.recordings and not state.loading:
            time.sleep(4)
            return client
    raise RuntimeError("the viewer did not open the recording")


def few_colours(picture: Image.Image) -> Image.Image:
    """Return a screenshot in 256 colours, a third of the bytes, with grounds even and colour bars whole.

    The median cut would give rare colours to the large areas.
    """
    return picture.convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)


def keep(picture: Image.Image, name: str) -> None:
    """Write a picture in few colours."""
    path = PICTURES / f"{name}.png"
    few_colours(picture).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def architecture(chosen: list[str]) -> None:
    """Rooms by floor; an arrow points from who imports to what is imported."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

    *rows, ground = floors()
    figure, ax = plt.subplots(figsize=(13.2, 15), dpi=90)
    places, widths = {}, {}
    for level, row in enumerate([*rows, ground]):
        width = _WIDTH if row is not ground else 3.1
        for k, room in enumerate(row):
            places[room] = ((k - (len(row) - 1) / 2) * (width + 0.35), -level * (_HEIGHT + _GAP))
            widths[room] = width
    # Everything stands on the ground floor: arrows to it would say nothing.
    for a, b in sorted(reduced({(a, b) for a, b in imports() if a not in ground and b not in ground})):
        (x, y), (to_x, to_y) = places[a], places[b]
        # Straight to the next floor, around the rooms between to lower ones.
        side = 1 if x + to_x >= 0 else -1
        around = side if y - to_y > 1.5 * (_HEIGHT + _GAP) and x == to_x else 0
        ends = [(px + _WIDTH / 2.6 * around, py) for px, py in ((x, y - _HEIGHT / 2), (to_x, to_y + _HEIGHT / 2))]
        look = {"arrowstyle": "-|>", "mutation_scale": 13, "lw": 1.3, "color": "#5d6d7e", "alpha": 0.8, "zorder": 1}
        ax.add_patch(FancyArrowPatch(*ends, connectionstyle=f"arc3,rad={-0.35 * around}", **look))
    for room, (x, y) in places.items():
        corner, look = (
            (x - widths[room] / 2, y - _HEIGHT / 2),
            {"facecolor": "#eef3f8", "edgecolor": "#34495e", "lw": 1.2},
        )
        ax.add_patch(FancyBboxPatch(corner, widths[room], _HEIGHT, boxstyle="round,pad=0.02", zorder=2, **look))
        ax.text(x, y + 0.25, room, ha="center", va="center", weight="bold", fontsize=13, zorder=3)
        lines = textwrap.wrap(purpose(room), 54 if widths[room] > 4 else 36, max_lines=2, placeholder=" …")
        ax.text(x, y - 0.2, "\n".join(lines), ha="center", va="center", fontsize=8.6, zorder=3)
    ax.set_xlim(-7.6, 7.6)
    ax.set_ylim(-len(rows) * (_HEIGHT + _GAP) - 0.7, 0.7)
    ax.axis("off")
    figure.tight_layout()
    figure.savefig(PICTURES / "architecture.png")


def floors() -> list[list[str]]:
    """Rooms from the top floor down, as the import rules state them."""
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    rooms = next(rule["layers"] for rule in rules if rule.get("containers") == ["stitch"])
    return [[name.strip() for name in row.split(":")] for row in rooms]


def imports() -> set[tuple[str, str]]:
    """Pairs of rooms of which the first imports from the second."""
    import grimp

    graph = grimp.build_graph("stitch", include_external_packages=False)
    pairs = {(a, b) for a in graph.modules for b in graph.find_modules_directly_imported_by(a)}
    rooms = {(a.split(".")[1], b.split(".")[1]) for a, b in pairs if "." in a and "." in b}
    return {(a, b) for a, b in rooms if a != b}


def reduced(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs that do not follow from others (transitive reduction)."""
    reach = set(pairs)
    while more := {(a, d) for a, b in reach for c, d in pairs if b == c} - reach:
        reach |= more
    return {(a, b) for a, b in pairs if not any((a, c) in pairs and (c, b) in reach for c in {y for _, y in pairs})}


def purpose(room: str) -> str:
    """The first line of a room's docstring."""
    folder = ROOT / "stitch" / room / "__init__.py"
    file = folder if folder.is_file() else ROOT / "stitch" / f"{room}.py"
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.splitlines()[0].rstrip(".") if text else ""


if __name__ == "__main__":
    main()

"""Pictures of pages and recording of the demo's cell, as people see them: python -m bench.docs.report_pictures.

Writes docs/pictures/report-*.png (light, dark, phone), two-runs.png (the run before and after an effect was added) and
recording-*.png (the first tab and the cell). Needs a Chromium on the path, and a software renderer for Rerun (Mesa's
Vulkan drivers).
"""

import argparse
import io
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import rerun.experimental as viewer
from PIL import Image

from stitch.cli.main import main as stitch
from stitch.cli.report import printing_browser

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
_DRAWN = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--hide-scrollbars")
_PAGES = {
    "report-light": (1400, 1040),
    "report-dark": (1400, 1040, "--blink-settings=preferredColorScheme=0"),
    "report-phone": (500, 1500),
}
_PORT, _WINDOW, _TITLE = 9923, "1400x860", 37
_TABS = {"before-after": "Before | after", "cell": "The cell"}


def demo_run(folder: Path) -> Path:
    """The demo's cell, what is missing found and added; beside it the run before."""
    call(["demo", folder / "demo"])
    session, before = folder / "demo" / "blade", folder / "before"
    call(["run", session, "-o", before, "--tolerance", "0.05"], ["diagnose", before])
    return folder / "demo" / "run"


def call(*commands: list[object]) -> None:
    """Run commands of stitch."""
    for command in commands:
        try:
            stitch([str(word) for word in command])
        except SystemExit as ended:
            if ended.code:
                raise


def two(before: Path, run: Path) -> None:
    """The page of a run and of what became of it."""
    page = run / "two-runs.html"
    call(["report", before, run, "-o", page])
    keep(shot(page, 1100, 1500), "two-runs")


def pages(run: Path) -> None:
    """The page in a browser: light, dark, on a phone."""
    for name, (width, height, *more) in _PAGES.items():
        keep(shot(run / "report.html", width, height, *more), name)


def shot(page: Path, width: int, height: int, *more: str) -> Image.Image:
    """The top of a page, so many pixels wide and high."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "shot.png"
        options = [f"--window-size={width},{height}", "--virtual-time-budget=6000", f"--screenshot={file}", *more]
        command = [printing_browser(), "--headless=new", "--no-sandbox", *_DRAWN, *options, page.resolve().as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=180)
        return Image.open(file).convert("RGB")


def recording(run: Path) -> None:
    """Tabs of the recording."""
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
                    tabs["active_tab"] = next(own for own in tabs["contents"] if tab in _names(blueprint[f"/{own}"]))
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


def _taken(client: viewer.ViewerClient) -> bytes:
    """A picture of what is shown; a viewer that draws on a busy processor may need several tries."""
    for _ in range(5):
        try:
            return bytes(client.take_screenshot())
        except TimeoutError:
            time.sleep(5)
    raise RuntimeError("the viewer gave no picture: is the machine busy?")


def _loaded() -> viewer.ViewerClient:
    """The viewer, when it has read the whole recording."""
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
    path = FOLDER / f"{name}.png"
    few_colours(picture).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="a run folder, instead of the demo's cell")
    given = parser.parse_args().run
    with tempfile.TemporaryDirectory() as folder:
        added = None if given else demo_run(Path(folder))
        run = given or Path(folder) / "before"
        pages(run)
        if added is not None:
            two(run, added)
        recording(run)


if __name__ == "__main__":
    main()

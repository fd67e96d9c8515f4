"""Pictures of pages and recording of the demo's cell, as people see them: python -m bench.docs.report_pictures.

Writes docs/pictures/report-*.png (light, dark, phone, paper), two-runs.png (the run before and after an effect was
added) and recording-*.png (tabs, five moments of `model`).
Needs a Chromium on the path, a software renderer for Rerun (Mesa's Vulkan drivers), and pypdfium2 for paper.
"""

import argparse
import io
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import rerun.experimental as viewer
from PIL import Image

from stitch.cli.main import main as stitch
from stitch.cli.report import print_page, printing_browser

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
_DRAWN = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--hide-scrollbars")
_PAGES = {
    "report-light": (1100, 1500),
    "report-dark": (1100, 1500, "--blink-settings=preferredColorScheme=0"),
    "report-phone": (500, 1500),
}
_PORT, _WINDOW, _TITLE = 9923, "1400x760", 37
MOMENTS = (0, 10, 15, 20, 30)  # of the timeline `model`: a step every 10


def demo_run(folder: Path) -> Path:
    """A blade cell with two joints that give way, what is missing found and added."""
    session, run = folder / "blade", folder / "after"
    call(
        ["synth", "blade", session, "--hide", "joint_compliance=2", "--seed", "3"],
        ["run", session, "-o", run, "--no-recording"],
    )
    shutil.copytree(run, folder / "before")
    call(["add", run, "--suggested"])
    return run


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
    """The page in a browser: light, dark, on a phone, on paper."""
    browser, page = printing_browser(), run / "report.html"
    for name, (width, height, *more) in _PAGES.items():
        keep(shot(page, width, height, *more), name)
    print_page(browser, page, run / "report.pdf")
    try:
        from pypdfium2 import PdfDocument
    except ImportError:
        print("report-print.png: not made, pypdfium2 is not installed")
        return
    keep(PdfDocument(run / "report.pdf")[0].render(scale=1.4).to_pil(), "report-print")


def shot(page: Path, width: int, height: int, *more: str) -> Image.Image:
    """The top of a page, so many pixels wide and high."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "shot.png"
        options = [f"--window-size={width},{height}", "--virtual-time-budget=6000", f"--screenshot={file}", *more]
        command = [printing_browser(), "--headless=new", "--no-sandbox", *_DRAWN, *options, page.resolve().as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=180)
        return Image.open(file).convert("RGB")


def recording(run: Path) -> None:
    """Every tab of the recording, and the moments of `model`."""
    program = Path(sys.executable).with_name("rerun")
    arguments = [program, run / "recording.rrd", "--headless", "--port", str(_PORT), "--window-size", _WINDOW]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    shown = subprocess.Popen(arguments, **quiet, start_new_session=True)
    try:
        client = _loaded()
        for tab, name in enumerate(("before-after", "model", "missing", "cell", "error")):
            blueprint = client.get_blueprint().blueprint
            for node in blueprint.values():
                tabs = node.get("ContainerBlueprint", {})
                if tabs.get("container_kind") == "Tabs":
                    tabs["active_tab"] = tabs["contents"][tab]
            client.set_blueprint(blueprint, of="recording")
            time.sleep(5)
            for moment in MOMENTS if name == "model" else (None,):
                if moment is not None:
                    client.set_time("model", sequence=moment, play_state="paused")
                    time.sleep(2)
                picture = Image.open(io.BytesIO(_taken(client)))
                # The window's own bar says what machine took the picture.
                picture = picture.crop((0, _TITLE, *picture.size))
                keep(picture, f"recording-{name}" + ("" if moment is None else f"-{moment}"))
    finally:
        # The viewer too, which the launcher leaves behind: the next recording would open in it.
        os.killpg(shown.pid, signal.SIGTERM)
        shown.wait()


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
        run = given or demo_run(Path(folder))
        pages(run)
        if given is None:
            two(Path(folder) / "before", run)
        recording(run)


if __name__ == "__main__":
    main()

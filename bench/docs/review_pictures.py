"""Pictures of `stitch review`, click by click, and what it needs.

Run: python -m bench.docs.review_pictures [--session FOLDER]

Writes docs/pictures/review-*.png: the demo's cell with joint compliance hidden (seed 3), from opening to the error that
fell, a note, an effect of one's own, undo; in dark and on a phone; a session of labelled points. Prints start-up time,
memory and the time of every click. Needs playwright and a Chromium on the path. With --session the same clicks on a
session of one's own, without pictures.
"""

import argparse
import os
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, expect, sync_playwright

from bench.docs.page_folders import tracked_arm
from bench.docs.report_pictures import call
from bench.docs.review_clicks import LONG, Camera, after, story
from bench.docs.review_server import choices, memory, served
from stitch.cli.report import printing_browser

DRAWN = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--hide-scrollbars")
WIDE, PHONE = {"width": 1360, "height": 900}, {"width": 412, "height": 900}


@contextmanager
def named_folder():
    """A folder for a while, of a name that is fit to be seen on pictures."""
    folder = Path(tempfile.gettempdir()) / "cell"
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def looks(browser: Browser, address: str) -> None:
    """Dark, and on a phone."""
    for name, options in {
        "dark": {"viewport": WIDE, "color_scheme": "dark"},
        "phone": {"viewport": PHONE, "device_scale_factor": 2},
    }.items():
        page = browser.new_page(**options)
        page.goto(address)
        camera = Camera(page, keep=True)
        expect(page.locator("#scene.live")).to_be_visible(timeout=LONG)
        camera.says("#plots", "signed mean")
        camera.shoot(name)
        page.close()


def targets(browser: Browser, folder: Path) -> None:
    """An arm of which two joints are off, seen by labelled points: one end of a joint's range chosen."""
    tracked_arm(folder)
    call(["run", folder / "arm", "-o", folder / "arm-run", "--no-recording"])
    with served(folder / "arm-run") as (address, _):
        page = browser.new_page(viewport=WIDE)
        page.goto(address)
        camera = Camera(page, keep=True)
        expect(page.locator("#scene.live")).to_be_visible(timeout=LONG)
        camera.says("#doing", "Done: stitch compare")
        bars = page.locator("#plots [data-key^='j3 ']")
        camera.press(bars.nth(0))
        camera.says("#chosen", "residuals: rms")
        camera.shoot("targets")
        page.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--session", type=Path, help="a session, instead of the demo's cell; no pictures")
    parser.add_argument("--effect", help="the effect to add, instead of the one that is named")
    given = parser.parse_args()
    with named_folder() as folder, sync_playwright() as driver:
        session = given.session or folder / "blade"
        if given.session is None:
            call(["synth", "blade", session, "--hide", "joint_compliance=2", "--seed", "3"])
        call(["run", session, "-o", folder / "run", "--no-recording"])
        root = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = driver.chromium.launch(executable_path=printing_browser(), args=[*root, *DRAWN])
        with served(folder / "run") as (address, process):
            page = browser.new_page(viewport=WIDE)
            camera = Camera(page, keep=given.session is None)
            choices(folder / "run", address, process)
            page.goto(address)
            story(camera, given.effect)
            print(memory(process))
            if given.session is None:
                looks(browser, address)
                after(camera)
            print(f"memory of the server: {memory(process)}; errors on the console: {camera.wrong or 'none'}")
        if given.session is None:
            targets(browser, folder)
        browser.close()


if __name__ == "__main__":
    main()

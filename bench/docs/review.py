"""Pictures of `stitch review`, click by click, and what it needs: python -m bench.docs.review [--session FOLDER].

Writes docs/pictures/review-*.png: the demo's cell with joint compliance hidden (seed 3), from opening to the error that
fell, a note, an effect of one's own, undo; in dark and on a phone; a session of labelled points. Prints start-up time,
memory and the time of every click. Needs playwright and a Chromium on the path. With --session the same clicks on a
session of one's own, without pictures.
"""

import argparse
import os
import re
import shutil
import subprocess
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Locator, Page, expect, sync_playwright

from bench.docs.page_examples import tracked_arm
from bench.docs.pictures import DRAWN, call, few_colours
from bench.harness import PICTURES, STITCH
from stitch.cli.report import printing_browser

WIDE, PHONE = {"width": 1360, "height": 900}, {"width": 412, "height": 900}
LONG = 900_000  # ms that a command may take
OWN = '''from stitch.effects import effect, number


@effect("sensor", needs=["humidity_percent"], k=number("mm", typical=0.02, limit=1.0))
def humidity_bias(points, view, k):
    """x = x* + u·k·(humidity − first humidity)"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))
'''


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


@contextmanager
def named_folder():
    """A folder for a while, of a name that is fit to be seen on pictures."""
    folder = Path(tempfile.gettempdir()) / "cell"
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


class Camera:
    """A page, and pictures of it."""

    def __init__(self, page: Page, keep: bool) -> None:
        self.page, self.keep, self.begun = page, keep, time.monotonic()
        self.clicks = 0
        self.wrong: list[str] = []
        page.on("console", lambda told: self.wrong.append(told.text) if told.type == "error" else None)
        page.on("pageerror", lambda error: self.wrong.append(str(error)))

    def shoot(self, name: str, place: str | None = None) -> None:
        """A picture of what is seen, `place` in its middle."""
        print(f"{name}: {time.monotonic() - self.begun:.1f} s since the last")
        if self.keep:
            if place is not None:
                self.page.locator(place).scroll_into_view_if_needed()
            self.page.wait_for_timeout(1500)
            raw = PICTURES / f".{name}.new.png"
            self.page.screenshot(path=raw)
            few_colours(Image.open(raw)).save(PICTURES / f"review-{name}.png", optimize=True)
            raw.unlink()
        self.begun = time.monotonic()

    def click(self, name: str) -> None:
        self.press(self.page.get_by_role("button", name=name, exact=True))

    def press(self, button: Locator) -> None:
        button.click()
        self.clicks += 1

    def says(self, place: str, text: str) -> None:
        expect(self.page.locator(place)).to_contain_text(text, timeout=LONG)


def story(camera: Camera, effect: str | None) -> None:
    """From opening to the error that fell, and back."""
    page = camera.page
    camera.says("#plots", "signed mean")
    camera.says("#doing", "Done: stitch compare")
    camera.shoot("1-open")
    # Where a joint bends under load, its angle tells.
    bars = page.locator("#plots [data-key^='j2 ']")
    camera.press((bars if bars.count() else page.locator("#plots .plot:not(.wide) .bins button")).nth(1))
    camera.says("#chosen", "residuals: rms")
    camera.shoot("2-chosen")
    camera.click("Find what is missing")
    camera.says("#missing", "candidate effect")
    named, adds = page.locator("#missing tr.best td"), page.get_by_role("button", name=re.compile("^Add "))
    expect(adds.first).to_be_enabled(timeout=LONG)
    if effect is None:
        # Where nothing is named, the first candidate effect that may be tried.
        told = adds.first.get_attribute("aria-label") or ""
        effect = named.first.inner_text() if named.count() else told.removeprefix("Add ")
    camera.shoot("3-missing", "#missing .candidate")
    # Of labelled points nothing is predicted place by place.
    if page.get_by_role("button", name=f"Show the part as {effect} should leave it").count():
        camera.click(f"Show the part as {effect} should leave it")
        page.wait_for_timeout(1500)
        camera.shoot("4-predicted", "#missing .candidate")
    camera.click(f"Add {effect}")
    camera.says("#doing", "fit ")
    camera.shoot("5-adding", "#missing .candidate")
    camera.says("#ledger", f"+ {effect}")
    # What the plots lack after a fit is compared anew by itself.
    camera.says("#doing", "Done: stitch compare")
    camera.shoot("6-fell", "#undo")
    print(f"{camera.clicks} clicks from opening to the model with {effect}: {page.locator('#tiles').inner_text()!r}")


def after(camera: Camera) -> None:
    """A note, an effect of one's own, undo."""
    page = camera.page
    page.locator("#note").fill("joints 2 and 3 are soft: tell the maker of the arm")
    page.locator("#by").fill("reviewer")
    camera.click("Keep")
    camera.says("#ledger", "tell the maker")
    page.locator("#own-title").click()
    page.locator("#own").fill(OWN)
    page.locator("#own-trust").check()
    camera.click("Check")
    camera.says("#own-told", "It is an effect")
    camera.shoot("7-own", "#own-told")
    camera.click("Try it: diagnose with it")
    camera.says("#own-told", "Tried")
    page.locator("#undo").click()
    camera.says("#ledger", "− joint_compliance")
    camera.says("#redo", "Redo: add joint_compliance")
    camera.shoot("8-undone", "#undo")


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


@contextmanager
def served(run: Path):
    """`stitch review RUN`; its address and process, with the seconds until it answers."""
    words = [*STITCH, "review", str(run), "--no-browser"]
    begun = time.monotonic()
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        address = process.stderr.readline().strip()
        print(f"listens after {time.monotonic() - begun:.1f} s")
        yield address, process
    finally:
        process.terminate()
        process.wait()


def memory(process: subprocess.Popen[str]) -> str:
    """Present and largest resident memory of the server, where /proc tells."""
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return "memory unknown"
    sizes = {line.split(":")[0]: int(line.split()[1]) / 1e3 for line in status.splitlines() if line.startswith("Vm")}
    return f"{sizes['VmRSS']:.0f} MB, {sizes['VmHWM']:.0f} MB at most"


if __name__ == "__main__":
    main()

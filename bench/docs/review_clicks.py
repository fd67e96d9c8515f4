"""The clicks of a review in a browser, from opening to the error that fell and back, with a picture of each."""

import re
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Locator, Page, expect

from bench.docs.report_pictures import few_colours

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
LONG = 900_000  # ms that a command may take
OWN = '''from stitch.effects import effect, number


@effect("sensor", needs=["humidity_percent"], k=number("mm", typical=0.02, limit=1.0))
def humidity_bias(points, view, k):
    """x = x* + u·k·(humidity − first humidity)"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))
'''


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
            raw = FOLDER / f".{name}.new.png"
            self.page.screenshot(path=raw)
            few_colours(Image.open(raw)).save(FOLDER / f"review-{name}.png", optimize=True)
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

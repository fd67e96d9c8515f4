"""The whole story in a browser: where it fails, what is missing, add it, the error falls, undo it."""

import json
import os

import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.write import write_session
from stitch.cli.printing import printing_browser
from stitch.errors import InputError
from tests.viz.review.conftest import compare_without_picture, served

playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
# A software renderer draws the part where there is no graphics card.
DRAWN = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
LONG = 120_000  # ms that a command may take on a busy machine


@pytest.fixture(scope="module")
def browser():
    try:
        path = printing_browser()
    except InputError:
        pytest.skip("no Chromium is on the path")
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=path, args=[*root, *DRAWN])
        yield opened
        opened.close()


class Story:
    """A page that is clicked through; what went wrong on it, and where it asked."""

    def __init__(self, browser, address, **options):
        self.page = browser.new_page(viewport={"width": 1300, "height": 900}, **options)
        self.clicks, self.wrong, self.asked = 0, [], []
        self.page.on(
            "console", lambda told: self.wrong.append(told.text) if told.type in ("error", "warning") else None
        )
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(address)
        self.expect("#scene.live").to_be_visible()

    def expect(self, place):
        return playwright.expect(self.page.locator(place))

    def click(self, name, **options):
        self.page.get_by_role("button", name=name, **options).click()
        self.clicks += 1

    def says(self, place, text):
        self.expect(place).to_contain_text(text, timeout=LONG)


@pytest.fixture(scope="module")
def soft_joint(tmp_path_factory, stitch_command):
    """A run of a cell in which two joints give way, and nobody said so."""
    folder = tmp_path_factory.mktemp("story")
    hidden = {"joint_compliance": 3.0}
    write_session(
        folder / "s", measured_blade(3, views=10, pixels=55, hidden=hidden, repeatability=(5e-6, 0.005)), "blade"
    )
    stitch_command("run", folder / "s", "-o", folder / "r", "--no-recording")
    compare_without_picture(folder / "r")
    return folder / "r"


def test_from_opening_to_error_fell_in_six_clicks(browser, soft_joint):
    with served(soft_joint) as server:
        story = Story(browser, server.address)
        story.says("#tiles", "rms on views left out")
        title = story.page.locator("#scene [data-title]")
        everything = title.inner_text()
        story.page.locator("#plots .plot:not(.wide) .bins button").first.click()
        story.clicks += 1
        story.says("#chosen", "residuals: rms")
        playwright.expect(title).not_to_have_text(everything)
        story.click("Find what is missing")
        story.says("#missing", "joint_compliance is missing")
        story.click("Show the part as joint_compliance should leave it")
        playwright.expect(title).to_contain_text("if joint_compliance were added")
        story.click("Add joint_compliance")
        story.says("#ledger", "+ joint_compliance")
        story.says("#sentence", "Adding joint_compliance brought the views from")
        assert story.clicks <= 6
        ledger = json.loads((soft_joint / "ledger.json").read_text())
        before, after = (step["heldout_rms"] for step in ledger)
        assert after < 0.8 * before
        story.says("#tiles", f"−{round(100 * (1 - after / before))} %")
        story.says("#undo", "Undo: drop joint_compliance")
        assert not story.wrong
        assert all(url.startswith(server.address) for url in story.asked)
        story.page.close()

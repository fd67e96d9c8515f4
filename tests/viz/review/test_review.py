"""The whole story in a browser: where it fails, what is missing, add it, the error falls, undo it."""

import json
import re

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.write import write_session
from tests.in_browser import barriers
from tests.viz.review.conftest import compare_without_picture, served

playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
LONG = 120_000  # ms that a command may take on a busy machine
playwright.expect.set_options(timeout=LONG)


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
        # Clicks too: a viewer drawn by a busy processor keeps a page waiting.
        self.page.set_default_timeout(LONG)
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
        folder / "s", measured_blade(3, views=10, pixels=90, hidden=hidden, repeatability=(5e-6, 0.005)), "blade"
    )
    stitch_command("run", folder / "s", "-o", folder / "r", "--no-recording")
    compare_without_picture(folder / "r")
    return folder / "r"


def mean_on_part(run, step):
    """How far the views disagree at a step of the model, mm."""
    steps = json.loads((run / "result.json").read_text())["disagreement"]["steps"]
    return next(row["mean"] for row in steps if row["step"] == step)


@pytest.fixture(scope="module")
def address(soft_joint):
    with served(soft_joint) as server:
        yield server.address


@pytest.mark.slow
@pytest.mark.parametrize("colours", ["light", "dark"])
def test_everybody_can_read_and_reach_the_page(browser, address, colours):
    story = Story(browser, address, color_scheme=colours)
    page = story.page
    story.says("#plots", "signed mean")
    assert barriers(page) == []
    # By the keyboard alone: a bar is reached and chosen.
    page.locator("#plots .bins button").first.focus()
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    story.says("#chosen", "residuals: rms")
    assert page.evaluate("() => document.activeElement.getAttribute('aria-pressed')") == "true"
    page.set_viewport_size({"width": 390, "height": 800})
    assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth")
    assert not story.wrong
    page.close()


# In `make test` piece by piece: test_first_run.py, test_web_app.py.
@pytest.mark.slow
def test_from_opening_to_error_fell_in_six_clicks(browser, soft_joint, address):
    story = Story(browser, address)
    story.says("#tiles", "rms on held-out views")
    title = story.page.locator("#scene [data-title]")
    everything = title.inner_text()
    story.page.locator("#plots .plot:not(.wide) .bins button").first.click()
    story.clicks += 1
    story.says("#chosen", "residuals: rms")
    playwright.expect(title).not_to_have_text(everything)
    story.click("Find what is missing")
    story.says("#missing", "joint_compliance is missing")
    assert story.page.locator("#sentence").inner_text().startswith("Joint ")
    story.click("Show the part as joint_compliance should leave it")
    playwright.expect(title).to_contain_text("if joint_compliance were added")
    told = json.loads((soft_joint / "diagnosis.json").read_text())["screen"]
    assert told["now"]["mean"] == pytest.approx(mean_on_part(soft_joint, "hand-eye alone"), rel=0.05)
    # Why: a dot of the joint that gives way for every view, and one of them shows its view.
    story.says("#why h3", "joint")
    dots = story.page.locator("#why .dot")
    assert dots.count() == 10
    # The numbers below speak of what is seen, and the choice is one click away.
    story.says("#chosen", "Predicted: joint_compliance")
    story.says("#chosen", "Back to ")
    story.click("Add joint_compliance")
    story.says("#ledger", "+ joint_compliance")
    story.says("#sentence", "Adding joint_compliance brought the views from")
    assert story.clicks <= 6
    # What was predicted has come.
    predicted = next(c["mean"] for c in told["candidates"] if c["effect"] == "joint_compliance")
    assert predicted == pytest.approx(mean_on_part(soft_joint, "+ joint_compliance"), rel=0.2)
    ledger = json.loads((soft_joint / "ledger.json").read_text())
    before, after = (step["heldout_rms"] for step in ledger)
    assert after < 0.8 * before
    story.says("#tiles", f"−{round(100 * (1 - after / before))} %")
    story.says("#undo", "Undo: drop joint_compliance")
    assert not story.wrong
    assert all(url.startswith(address) for url in story.asked)
    story.page.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["points", "frames"])
def test_the_story_of_labelled_points(browser, kind, tmp_path, stitch_command):
    """Targets are seen where they stood, chosen by a click, and fade when an effect is added."""
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(2, views=24, offset=offset, probe=kind == "frames")
    folder, run = write_labelled(tmp_path / "s", session, kind), tmp_path / "r"
    stitch_command("run", folder, "-o", run, "--no-recording")
    with served(run) as server:
        story = Story(browser, server.address)
        title = story.page.locator("#scene [data-title]")
        rms = json.loads((run / "result.json").read_text())["residual_rms"]
        said = f"hand-eye alone: the views see the targets {1e3 * rms:.3g} µm off their place, rms"
        playwright.expect(title).to_contain_text(said)
        story.says("#plots", "signed mean")
        playwright.expect(story.page.locator("#plots")).not_to_contain_text("false")
        assert barriers(story.page) == []
        # The mark in the middle of the picture may be any: some click near it meets one.
        canvas = story.page.locator("#scene canvas").bounding_box()
        for share in np.linspace(0.1, 0.9, 60):
            story.page.mouse.click(canvas["x"] + canvas["width"] / 2, canvas["y"] + share * canvas["height"])
            if story.page.locator("#plots [aria-pressed=true]").count():
                break
        story.says("#chosen", "1 of 24 views")
        playwright.expect(title).to_contain_text("chosen: the views see the targets")
        story.click("Find what is missing")
        story.says("#missing", "joint_offset is missing")
        story.click("Add joint_offset")
        story.says("#ledger", "+ joint_offset")
        story.says("#scene [data-steps]", "+ joint_offset")
        assert not story.wrong
        assert all(url.startswith(server.address) for url in story.asked)
        story.page.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["david", "rubik"])
def test_the_story_on_a_real_object(browser, reghec, name, tmp_path, stitch_command):
    """Whatever is found there: it can be looked at, asked, changed and undone."""
    stitch_command("run", reghec(name), "-o", tmp_path / "r")
    with served(tmp_path / "r") as server:
        story = Story(browser, server.address)
        story.says("#plots", "signed mean")
        story.page.locator("#plots .plot:not(.wide) .bins button").first.click()
        story.says("#chosen", "residuals: rms")
        story.click("Find what is missing")
        story.says("#missing", "candidate effect")
        tried = story.page.locator("#tried > summary")
        if tried.count():
            tried.click()
        adds = story.page.get_by_role("button", name=re.compile("^Add "))
        playwright.expect(adds.first).to_be_enabled(timeout=LONG)
        effect = adds.first.get_attribute("aria-label").removeprefix("Add ")
        adds.first.click()
        story.says("#ledger", f"+ {effect}")
        playwright.expect(story.page.locator("#undo")).to_be_enabled(timeout=LONG)
        story.page.locator("#undo").click()
        story.says("#ledger", f"− {effect}")
        assert [step["effects"] for step in json.loads((tmp_path / "r" / "ledger.json").read_text())] == [
            [],
            [effect],
            [],
        ]
        assert not story.wrong
        # The recording follows the model, and opens in the Rerun viewer, which warns of much on the console.
        story.page.locator("#recording-details > summary").click()
        frame = story.page.frame_locator("#recording iframe")
        playwright.expect(frame.locator("#the_canvas_id.visible")).to_be_visible(timeout=LONG)
        assert all(url.startswith((server.address, "blob:", "data:")) for url in story.asked)
        story.page.close()

"""The page of a run: what it says, what it needs, and whether it can be read."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from markupsafe import escape

from stitch.output.comparison.disagreement_field import model_history
from stitch.output.comparison.run_verdict import check_tolerance, plain_verdict, run_headline
from stitch.output.result_document import result_document
from tests.in_browser import require_for_everybody
from viz.page_parts import render, unbroken
from viz.run_page import write_report

LARGEST = 1_500_000  # bytes that open at once on a phone


class Addresses(HTMLParser):
    """What a page names: pictures, scripts, links."""

    def __init__(self, page):
        super().__init__()
        self.found = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.found += [text for name, text in attributes if name in ("src", "href", "data", "action") and text]


@pytest.fixture(scope="module")
def file(recorded, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "r.html"
    write_report(recorded[0], path, tolerance=0.1)
    return path


@pytest.fixture(scope="module")
def page(file):
    return file.read_text(encoding="utf-8")


def test_the_page_says_what_the_result_says(recorded, page):
    """Every number of the titles is that of result.json."""
    run = recorded[0]
    data = json.loads(re.search(r'id="part-data">(.*?)</script>', page, re.S)[1])
    stated = result_document(run)["disagreement"]["steps"]
    assert [step["name"] for step in data["steps"]] == [row["step"] for row in stated]
    shown, kept = ([step["mean"] for step in data["steps"]], [row["mean"] * 1e3 for row in stated])
    np.testing.assert_allclose(shown, kept, rtol=1e-9)
    for um in kept:
        assert f"<td>{um:,.0f}</td>" in page if um >= 1e3 else f"<td>{um:.3g}</td>" in page
    assert unbroken(plain_verdict(model_history(run), "mm")) in page
    assert escape(unbroken(run.verdict)) in page


def test_the_page_needs_nothing_beside_it_and_can_be_mailed(page):
    assert all(address.startswith("data:") for address in Addresses(page).found)
    assert not re.search(r"https?:|@import|url\((?!data:)|fetch\(|XMLHttpRequest|WebSocket|sendBeacon|import\(", page)
    assert len(page.encode()) < LARGEST


@pytest.mark.parametrize(
    "way", ["light", pytest.param("dark", marks=pytest.mark.slow), pytest.param("phone", marks=pytest.mark.slow)]
)
def test_everybody_can_read_and_reach_it(browser, file, way):
    require_for_everybody(browser, file, way)


def test_the_headline_of_a_doubtful_session_is_short_and_what_to_do_is_folded(recorded, tmp_path):
    """What a wall, a knock that these views do not tell from another, and a torn session make of it."""
    doubts = (
        "13% of what the scans show stands still before the scanner: a wall, at 12 places. State within = [[0]], and on.",
        "From view v4 on the part sits elsewhere (or the scanner: not told. Which?), 5 mm off: no hand-eye holds.",
        "No arm scatters by 3.2 mm and 0.5 mrad: several rows or scans are wrong.",
    )
    run = replace(recorded[0], doubts=doubts)
    said = run_headline(run, model_history(run))
    assert said.startswith(
        "13% of what the scans show stands still before the scanner. From view v4 on the part sits elsewhere (or the "
        "scanner: not told. Which?), 5 mm off. No arm scatters by 3.2 mm and 0.5 mrad. "
    )
    assert said.endswith(plain_verdict(model_history(run), "mm"))
    write_report(run, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    first, rest = (
        said.removesuffix(plain_verdict(model_history(run), "mm")).strip(),
        plain_verdict(model_history(run), "mm"),
    )
    assert f'<p class="verdict">{escape(unbroken(first))}</p><p class="evidence">{escape(unbroken(rest))}' in page
    folded = page[page.index('<details class="doubts">') :]
    assert all(str(escape(unbroken(doubt))) in folded[: folded.index("</details>")] for doubt in doubts)


def test_words_can_be_read_on_light_and_dark():
    """WCAG 2.2, 1.4.3: 4.5 to 1 for text; 1.4.11: 3 to 1 for what is no text."""
    style = re.search(r"<style>(.*?)</style>", render("frame.html.j2"), re.S)[1]
    light, dark, paper = (
        dict(re.findall(r"--([a-z-]+): (#[0-9a-f]+)", block)) for block in re.findall(r":root \{(.*?)\}", style, re.S)
    )
    for colours in (light, dark, paper):
        for ground in ("page", "card"):
            for ink in ("text", "soft", "accent"):
                assert contrast(colours[ink], colours[ground]) >= 4.5, (ink, ground)
            for lamp in ("good", "check", "bad"):
                assert contrast(colours[lamp], colours[ground]) >= 3.0, (lamp, ground)
        assert contrast(colours["note-text"], colours["note"]) >= 4.5
        # A button that is pressed writes in the page's colour.
        assert contrast(colours["page"], colours["accent"]) >= 4.5


def test_the_light_follows_the_tolerance(recorded):
    """What 95 % of the part keep, from the fields themselves, a little more and a little less."""
    history = model_history(recorded[0])
    reaches = [
        np.nanquantile(np.nanmean(np.abs(step.field.values), axis=0)[np.isfinite(step.field.overall)], 0.95)
        + 2 * np.nanmedian(step.field.sigma)
        for step in (history.models[-1], history.steps[-1])
    ]
    assert reaches[1] < reaches[0]
    tolerances = (1.01 * reaches[0], np.mean(reaches), 0.99 * reaches[1])
    assert [check_tolerance(history, t, "mm").light for t in tolerances] == ["good", "check", "bad"]


def contrast(one, other):
    """Of two colours #rgb or #rrggbb, by the definition of WCAG."""
    bright, dim = sorted((luminance(one), luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def luminance(colour):
    digits = colour.lstrip("#")
    digits = "".join(2 * d for d in digits) if len(digits) == 3 else digits
    shares = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    red, green, blue = (s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue

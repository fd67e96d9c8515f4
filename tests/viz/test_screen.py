"""The screen of a page, as a browser shows it: two parts, a legend, why, and candidates to compare."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from stitch.output.comparison.disagreement_field import model_history
from viz.run_page import write_report

# A model with one more effect: a screen of diagnosis.json whose prediction halves the field.
_SCREEN = "<!-- screen begins --><!-- screen ends -->"
_MISSING = re.compile("<!-- missing begins -->.*?<!-- missing ends -->", re.S)


@pytest.fixture(scope="module")
def told(recorded, tmp_path_factory):
    """A page after a diagnosis whose numbers are known."""
    run = recorded[0]
    field = model_history(run).models[-1].field.overall
    now = [float(x) if np.isfinite(x) else None for x in field]
    why = {
        "follows": "view order",
        "unit": "",
        "of": "the part",
        "value_unit": "mm",
        "views": list(range(5)),
        "at": [0.0, 1.0, 2.0, 3.0, 4.0],
        "measured": [0.0, 0.002, 0.1, 0.104, 0.098],
        "sigma": [0.003] * 5,
        "predicted": [0.0, 0.0, 0.1, 0.1, 0.1],
    }
    mean, worst = float(np.nanmean(field)), float(np.nanmax(field))
    half = {
        "effect": "part_slip",
        "field": [x and x / 2 for x in now],
        "heldout": 0.02,
        "mean": mean / 2,
        "worst": worst / 2,
    }
    screen = {
        "now": {"heldout": 0.04, "mean": mean, "worst": worst, "field": now},
        "why": why,
        "candidates": [half | {"why": why}],
        "places": model_history(run).patches.points.tolist(),
        "verdict": "missing_effect",
        "named": ["part_slip"],
        "um": 1e3,
    }
    path = tmp_path_factory.mktemp("screen") / "r.html"
    write_report(run, path, tolerance=0.05)
    page = path.read_text(encoding="utf-8")
    assert _SCREEN in page
    page = page.replace(_SCREEN, f'<script type="application/json" id="screen-data">{json.dumps(screen)}</script>')
    button = '<button type="button" data-show="part_slip" aria-pressed="false">Show</button>'
    path.write_text(_MISSING.sub(f'<div class="card missing">{button}</div>', page), encoding="utf-8")
    return SimpleNamespace(path=path, mean=1e3 * mean, worst=1e3 * worst, views=run.session.names)


@pytest.fixture
def page(browser, told):
    page, wrong = browser.new_page(viewport={"width": 1300, "height": 950}), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(told.path.as_uri(), timeout=120_000)
    page.wait_for_selector("[data-why] svg")
    yield page
    assert not wrong
    page.close()


def test_left_is_now_and_right_is_what_is_predicted(page, told):
    now, then = (page.locator(f"[data-{side}] h2").inner_text().replace("\u00a0", " ") for side in ("now", "then"))
    shown = [float(re.search(r"([\d.]+) µm on average", title)[1]) for title in (now, then)]
    assert now.startswith("Now") and "part_slip (predicted)" in then
    assert shown == pytest.approx([told.mean, told.mean / 2], rel=0.06)
    colours = page.evaluate(
        "() => ['now', 'then'].map(side => { const c = document.querySelector(`[data-${side}] canvas`); const d = document"
        ".createElement('canvas'); d.width = d.height = 9; d.getContext('2d').drawImage(c, 0, 0, 9, 9); return [...d"
        ".getContext('2d').getImageData(4, 4, 1, 1).data]; })"
    )
    assert colours[0] != colours[1]


def test_why_has_a_dot_for_every_view_and_a_line_that_jumps(page, told):
    dots = page.locator("[data-why] .dot")
    assert dots.count() == len(told.views)
    said = dots.nth(3).get_attribute("aria-label").replace("\u00a0", " ")
    assert said == f"{told.views[3]}, 3: measured 104 ± 6 µm, predicted 100 µm"
    assert page.locator("[data-why] text", has_text=f"from {told.views[2]} on").count() == 1


def test_a_dot_shows_its_view_and_again_all(page, told):
    dot = page.locator("[data-why] .dot").nth(2)
    dot.press("Enter")
    assert f"view {told.views[2]} against the others" in page.locator("[data-now] h2").inner_text()
    dot.press("Enter")
    assert "on average" in page.locator("[data-now] h2").inner_text()


def test_a_click_on_the_part_tells_the_place_before_and_after(page):
    canvas = page.locator("[data-now] canvas")
    box = canvas.bounding_box()
    canvas.click(position={"x": box["width"] / 2, "y": box["height"] / 2})
    said = page.locator("[data-told]").inner_text().replace("\u00a0", " ")
    before, after = re.search(r"This place: ([\d.]+) µm → ([\d.]+) µm, ± [\d.]+ µm, \d views see it", said).groups()
    assert float(after) == pytest.approx(float(before) / 2, rel=0.02)


def test_both_parts_turn_together(page):
    before = [page.locator(f"[data-{side}] canvas").screenshot() for side in ("now", "then")]
    page.locator("[data-now] canvas").press("ArrowLeft")
    page.wait_for_timeout(300)
    assert all(
        old != page.locator(f"[data-{side}] canvas").screenshot()
        for old, side in zip(before, ("now", "then"), strict=True)
    )


def test_the_legend_tells_what_share_is_within_the_tolerance(page):
    told = page.locator("[data-within]").inner_text().replace("\u00a0", " ")
    first, second = (int(x) for x in re.search(r"Within 50 µm: (\d+) % → (\d+) %", told).groups())
    assert 0 < first <= second <= 100
    assert "Hatched: no other view" in page.locator("#screen").inner_text()


def test_without_webgl_the_part_is_drawn_all_the_same(browser, told):
    page = browser.new_page(viewport={"width": 1300, "height": 950})
    page.add_init_script(
        "const own = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext = function (kind, ...m) "
        "{ return kind === 'webgl2' ? null : own.call(this, kind, ...m); };"
    )
    page.goto(told.path.as_uri(), timeout=120_000)
    page.wait_for_selector("[data-why] svg")
    page.wait_for_timeout(800)
    seen = page.evaluate(
        "() => { const c = document.querySelector('[data-now] canvas'); return c.getContext('2d').getImageData(0, 0, c.width,"
        " c.height).data.some((v, i) => i % 4 === 3 && v > 0); }"
    )
    assert seen
    page.close()

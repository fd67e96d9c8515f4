"""The page of a run: what it says and needs, its screen in a browser, runs on labelled points.

What a diagnosis draws below the screen: where the error comes from, how the scanner errs, what may stand in for what.
"""

import base64
import html
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from markupsafe import escape

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.labelled_arm import labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from data_synth.shapes import build_shape
from data_synth.write import write_session
from stitch.api.pipeline import diagnose, run
from stitch.cli.main import main
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.numerics import frames
from stitch.observations.surfaces.field_error import FieldError, FieldMap
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import check_tolerance, plain_verdict, run_headline, run_light
from stitch.output.result_document import result_document
from tests.in_browser import require_for_everybody
from viz.cad_deviation import cad_sentence
from viz.diagnosis_plots import budget_rows, diagnosis_plots
from viz.page_parts import render, unbroken
from viz.review.chosen_field import Choice
from viz.review.run_review import RunReview
from viz.run_page import write_report

LARGEST = 1_500_000  # bytes that open at once on a phone
LINES = (
    BudgetLine("sensor noise", 0.3, 0.006, "mm"),
    BudgetLine("backlash", 0.6, 0.012, "mm"),
    BudgetLine("smooth, unnamed", 0.095, 0.004, "mm"),
    BudgetLine("wandering in time", 0.005, 0.001, "mm"),
)


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
    assert "<dt>Session</dt>" in page


@pytest.mark.slow
def test_the_page_says_whether_an_effect_brought_the_part_onto_its_cad(tmp_path):
    """The CAD in metres and in a frame of its own; nothing is said before the model was changed, or without a CAD."""
    measured = measured_blade(0, views=6, pixels=70, hidden={"link_geometry": 2.0})
    write_session(tmp_path / "s", measured, "blade")
    first = stitch.run(stitch.load_session(tmp_path / "s"))
    mesh = build_shape("blade").apply_transform(frames.exp(np.array([0.2, 0.1, -0.3, 40.0, -20.0, 9.0])))
    mesh.apply_scale(1e-3).export(tmp_path / "cad.ply")
    of_cad = {"cad": tmp_path / "cad.ply", "cad_unit": "m"}
    better = stitch.add(first, "link_geometry")
    told = cad_sentence(replace(better, session=replace(better.session, **of_cad)))
    assert re.fullmatch(r"Deviation from the CAD: .+ before, .+ with it \(rms\). The part got better.", told)
    assert cad_sentence(replace(first, session=replace(first.session, **of_cad))) == cad_sentence(better) == ""


def test_the_page_needs_nothing_beside_it_and_can_be_mailed(page):
    assert all(address.startswith("data:") for address in Addresses(page).found)
    assert not re.search(r"https?:|@import|url\((?!data:)|fetch\(|XMLHttpRequest|WebSocket|sendBeacon|import\(", page)
    assert len(page.encode()) < LARGEST


@pytest.mark.parametrize(
    "way", ["light", pytest.param("dark", marks=pytest.mark.slow), pytest.param("phone", marks=pytest.mark.slow)]
)
def test_everybody_can_read_and_reach_the_page(browser, file, way):
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


def test_beside_a_doubt_nothing_is_within_a_tolerance(recorded):
    """Views that hardly overlap agree to microns, and their cloud is off by as much as they slid."""
    run, history = recorded[0], model_history(recorded[0])
    wide = 1e3
    assert run_light(replace(run, doubts=()), history, wide).light == "good"
    found = run_light(
        replace(run, doubts=("These three views overlap too little to say how well they agree.",)), history, wide
    )
    assert found.light == "check" and found.sentence.startswith("In doubt")


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


# A model with one more effect: a screen of diagnosis.json whose prediction halves the field.
_SCREEN = "<!-- screen begins --><!-- screen ends -->"


_MISSING = re.compile("<!-- missing begins -->.*?<!-- missing ends -->", re.S)


@pytest.fixture(scope="module")
def diagnosed_page(recorded, tmp_path_factory):
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
        "predicted_sigma": [0.001] * 5,
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
    return SimpleNamespace(path=path, mean=1e3 * mean, worst=1e3 * worst, views=run.session.names, field=now)


@pytest.fixture(scope="module")
def opened(browser, diagnosed_page):
    """The page as it was opened once, and what went wrong on it since."""
    page, wrong = browser.new_page(), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(diagnosed_page.path.as_uri(), timeout=120_000)
    page.wait_for_selector("[data-why] svg")
    yield page, wrong
    page.close()


@pytest.fixture
def screen(opened):
    """The page for tests that leave their choices as they found them: how the part is turned does not count."""
    page, wrong = opened
    page.set_viewport_size({"width": 1300, "height": 950})
    yield page
    assert not wrong


def test_left_is_now_and_right_is_what_is_predicted(screen, diagnosed_page):
    now, then = (screen.locator(f"[data-{side}] h2").inner_text().replace("\u00a0", " ") for side in ("now", "then"))
    shown = [float(re.search(r"([\d.]+) µm on average", title)[1]) for title in (now, then)]
    assert now.startswith("Now") and "part_slip (predicted)" in then
    assert shown == pytest.approx([diagnosed_page.mean, diagnosed_page.mean / 2], rel=0.06)
    colours = screen.evaluate(
        "() => ['now', 'then'].map(side => { const c = document.querySelector(`[data-${side}] canvas`); const d = document"
        ".createElement('canvas'); d.width = d.height = 9; d.getContext('2d').drawImage(c, 0, 0, 9, 9); return [...d"
        ".getContext('2d').getImageData(4, 4, 1, 1).data]; })"
    )
    assert colours[0] != colours[1]


def test_why_has_a_dot_for_every_view_and_a_line_that_jumps(screen, diagnosed_page):
    dots = screen.locator("[data-why] .dot")
    assert dots.count() == len(diagnosed_page.views)
    said = dots.nth(3).get_attribute("aria-label").replace("\u00a0", " ")
    assert said == f"{diagnosed_page.views[3]}, 3: measured 104 ± 6 µm, predicted 100 ± 2 µm"
    assert screen.locator("[data-why] text", has_text=f"from {diagnosed_page.views[2]} on").count() == 1


def test_what_to_type_is_in_sight_at_once(screen):
    screen.set_viewport_size({"width": 1600, "height": 900})
    box = screen.locator(".next").bounding_box()
    assert box["y"] + box["height"] < 850


@pytest.mark.parametrize("count", [2, 3])
def test_a_chart_of_rivals_has_a_line_and_an_expectation_of_each(screen, count):
    """Over the dots of the first; expectations that part are not said to part elsewhere."""
    plot = screen.evaluate(
        """count => {
          const why = JSON.parse(document.getElementById("screen-data").textContent).why;
          const rivals = ["a", "b", "c"].slice(0, count).map(effect => ({ effect, why: { ...why, unit: "N m" } }));
          const expected = rivals.map((r, k) => ({ effect: r.effect, value: 0.1 * k, sigma: 0.01 }));
          return duelPlot(rivals, { at: 708, sigma: 0.01, expected }, null, 1e3);
        }""",
        count,
    )
    kinds = [series["kind"] for series in plot["spec"]["series"]]
    assert plot["title"].startswith({2: "Two", 3: "Three"}[count]) and "other directions" not in plot["title"]
    assert kinds.count("line") == count and kinds.count("dots") == count + 1
    assert plot["spec"]["stripe"]["said"].replace("\u00a0", " ") == "measure here: 708 N m"


def test_a_dot_shows_its_view_and_again_all(screen, diagnosed_page):
    dot = screen.locator("[data-why] .dot").nth(2)
    dot.press("Enter")
    assert f"view {diagnosed_page.views[2]} against the others" in screen.locator("[data-now] h2").inner_text()
    dot.press("Enter")
    assert "on average" in screen.locator("[data-now] h2").inner_text()


def test_a_click_on_the_part_tells_the_place_before_and_after(screen):
    canvas = screen.locator("[data-now] canvas")
    box = canvas.bounding_box()
    canvas.click(position={"x": box["width"] / 2, "y": box["height"] / 2})
    said = screen.locator("[data-told]").inner_text().replace("\u00a0", " ")
    before, after = re.search(r"This place: ([\d.]+) µm → ([\d.]+) µm, ± [\d.]+ µm, \d views see it", said).groups()
    assert float(after) == pytest.approx(float(before) / 2, rel=0.02)


def test_a_click_on_the_worst_places_number_brings_it_into_sight(screen):
    screen.locator("[data-tile=worst]").click()
    screen.locator("[data-now] .tag-text", has_text="worst").wait_for()
    assert "out of sight" not in screen.locator("[data-beyond]").inner_text()


def test_both_parts_turn_together(screen):
    before = [screen.locator(f"[data-{side}] canvas").screenshot() for side in ("now", "then")]
    screen.locator("[data-now] canvas").press("ArrowLeft")
    for old, side in zip(before, ("now", "then"), strict=True):
        for _ in range(100):
            if screen.locator(f"[data-{side}] canvas").screenshot() != old:
                break
            screen.wait_for_timeout(100)
        else:
            pytest.fail(f"the part does not turn: {side}")


def test_the_legend_tells_what_share_is_within_the_tolerance(screen, diagnosed_page):
    legend = screen.locator("[data-within]").inner_text().replace("\u00a0", " ")
    first, second = (int(x) for x in re.search(r"Within 50 µm: (\d+) % → (\d+) %", legend).groups())
    assert 0 < first <= second <= 100
    drawn = any(x is None for x in diagnosed_page.field)
    assert ("Hatched: no other view" in screen.locator("#screen").inner_text()) == drawn


def test_without_webgl_the_part_is_drawn_all_the_same(browser, diagnosed_page):
    page = browser.new_page(viewport={"width": 1300, "height": 950})
    page.add_init_script(
        "const own = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext = function (kind, ...m) "
        "{ return kind === 'webgl2' ? null : own.call(this, kind, ...m); };"
    )
    page.goto(diagnosed_page.path.as_uri(), timeout=120_000)
    page.wait_for_selector("[data-why] svg")
    page.wait_for_function(
        "() => { const c = document.querySelector('[data-now] canvas'); return c.getContext('2d').getImageData(0, 0, c.width,"
        " c.height).data.some((v, i) => i % 4 === 3 && v > 0); }",
        timeout=60_000,
    )
    page.close()


def said(capsys, *words):
    """What a command says to people, as one line."""
    try:
        main([str(word) for word in words])
    except SystemExit as stop:
        assert not stop.code
    printed = capsys.readouterr()
    return " ".join(f"{printed.err} {printed.out}".split())


def unpacked(values):
    """Numbers as the browser unpacks them; NaN where nobody knows."""
    counts = np.frombuffer(base64.b64decode(values["data"]), "<i2")
    return np.where(counts == -32768, np.nan, counts * values["count"])


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("kind", ["points", pytest.param("frames", marks=pytest.mark.slow)])
def test_labelled_runs_say_the_same_everywhere(kind, tmp_path, few_effects, capsys):
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(2, views=24, offset=offset, probe=kind == "frames")
    folder, before, run = write_labelled(tmp_path / "s", session, kind), tmp_path / "before", tmp_path / "after"
    said(capsys, "run", folder, "-o", run, "--no-recording")
    shutil.copytree(run, before)
    diagnosed = said(capsys, "diagnose", run)
    finding = json.loads((run / "diagnosis.json").read_text())
    named = "Missing in the model: joint_offset (a joint counts its angle from a wrong zero). "
    assert finding["plain"].startswith(f"{named}Adding it should reduce the error from ")
    state = RunReview(run).state()
    assert f"{finding['plain']} {finding['sentence']}" in diagnosed
    assert (state["diagnosis"]["plain"], state["diagnosis"]["sentence"]) == (finding["plain"], finding["sentence"])
    page = (run / "report.html").read_text()
    assert page.count(unbroken(finding["plain"])) == 1  # where the evidence stands
    screen = finding["screen"]
    assert all(unbroken(said) in html.unescape(page) for said in (screen["headline"], screen["proof"]))
    assert screen["candidates"][0]["effect"] == "joint_offset" and screen["why"]["of"].startswith("joint ")
    holds = "U of the hand-eye holds for a complete model"
    assert f"{holds}; whether an effect is missing has not been asked" in (before / "report.html").read_text()
    small = "The ± of the hand-eye are too small until the effect is added."
    assert all(small in said for said in (diagnosed, (run / "report.html").read_text()))
    added = said(capsys, "add", run, "joint_offset", "--no-recording")
    result, ledger = (json.loads((run / f"{name}.json").read_text()) for name in ("result", "ledger"))
    rms = [f"{1e3 * step['residual_rms']:.3g} µm" for step in ledger]
    assert result["plain"].startswith(
        f"Adding joint_offset brought the targets from {rms[0]} to {rms[1]} off their place"
    )
    state = RunReview(run).state()
    assert result["plain"] in added
    assert (state["sentence"], state["evidence"], state["part"]) == (result["plain"], result["verdict"], True)
    assert state["labelled"] and not state["outdated"]
    # The picture counts what the ledger does, step by step.
    scene = json.loads(RunReview(run).snapshot().part)
    names = ["coarse", "hand-eye alone", "+ joint_offset", "register"]
    assert [step["name"] for step in scene["steps"]] == names
    shown = [step["mean"] for step in scene["steps"][1:3]]
    assert shown == pytest.approx([1e3 * step["residual_rms"] for step in ledger], rel=0.02)
    assert shown[1] == pytest.approx(1e3 * result["residual_rms"], rel=1e-6)
    # Every mark has the value that residuals.parquet has of its view and target, also where one of them was chosen.
    table = pq.read_table(run / "residuals.parquet")
    distance = {
        (v, t): 1e3 * e
        for v, t, e in zip(*(table[c].to_pylist() for c in ("view", "partner", "residual")), strict=True)
    }
    marks = [tuple(mark) for mark in scene["marks"]]
    assert sorted(mark for mark in marks if any(mark)) == sorted(distance)
    some = {view for view, _ in distance if view.endswith("1")}
    for values, known in (
        (scene["steps"][2]["values"], distance),
        (
            RunReview(run).chosen(Choice(views=frozenset(some)))["chosen"]["values"],
            {key: e for key, e in distance.items() if key[0] in some},
        ),
    ):
        expected = np.array([known.get(mark, np.nan) for mark in marks])
        np.testing.assert_allclose(unpacked(values), expected, atol=values["count"])
    # Chosen in a plot, the numbers are those of `stitch compare`.
    said(capsys, "compare", run)
    tables = json.loads((run / "compare.json").read_text())["tables"]
    for table in (next(t for t in tables if t["name"] == name) for name in ("order", "j2")):
        chosen = RunReview(run).chosen(Choice(bins={table["name"]: (1, 1)}))["chosen"]
        assert (chosen["correspondences"], chosen["views"]) == (table["count"][1], table["views"][1])
        assert chosen["rms"] == pytest.approx(1e3 * table["rms"][1], rel=0.02)
    # The tolerance counts: 95 % of the distances as residuals.parquet has them, to a percent.
    reach = np.quantile(pq.read_table(run / "residuals.parquet")["residual"].to_numpy(), 0.95)
    for tolerance, light in ((1.01 * reach, "light good"), (0.99 * reach, "light bad")):
        said(capsys, "report", run, "--no-diagnosis", "--tolerance", tolerance)
        page = (run / "report.html").read_text()
        assert f'class="{light}"' in page
        assert unbroken(result["plain"]).replace("'", "&#39;") in page
    of_two = said(capsys, "report", before, run, "--tolerance", 1.01 * reach)
    assert f"by {rms[1]} instead of {rms[0]}, rms over the labelled points. The hand-eyes put the targets" in of_two
    page = (run / "two-runs.html").read_text()
    assert re.findall(r'class="light (\w+)"', page) == ["bad", "good"]
    assert "views of B" in page and "<canvas" not in page


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("21.9 µm: by 18.6 µm and 0.044 mrad", "21.9~µm: by 18.6~µm and 0.044~mrad"),
        ("c2 = 0.43 ± 0.04 µrad/(N m), c3", "c2~=~0.43~±~0.04~µrad/(N~m), c3"),
        ("g = −3 ± 1 ppm/°C", "g~=~−3~±~1~ppm/°C"),
        ("95 % of the part, 2.5 MB, 120 °C (1 σ)", "95~% of the part, 2.5~MB, 120~°C (1~σ)"),
        ("12 views, 3 scans, 4 models, 2 hours, 5 mms", "12 views, 3 scans, 4 models, 2 hours, 5 mms"),
        ("3 minutes; [1 0 0]; x = x* + u; p = 2e-22", "3 minutes; [1 0 0]; x = x* + u; p~=~2e-22"),
    ],
)
def test_numbers_stay_with_their_units(text, kept):
    assert unbroken(text).replace("\u00a0", "~") == kept


def test_pages_keep_them_together_and_markup_as_it_is():
    page = render("review.html.j2", nonce="", run="<b>5 mm</b>")
    assert "&lt;b&gt;5\u00a0mm&lt;/b&gt;" in page
    assert "1px solid" in page


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return diagnose(run(labelled_cell(3, views=30)[0]))


@pytest.fixture
def field() -> FieldMap:
    """Too near on the left, too far on the right by more; a corner without points."""
    x, y = np.linspace(-0.4, 0.4, 5), np.linspace(-0.2, 0.2, 3)
    error = np.tile([-0.02, -0.01, 0.0, 0.02, 0.04], (3, 1))
    error[0, 0] = np.nan
    return FieldMap(x, y, error, np.where(np.isfinite(error), 0.003, np.nan))


def test_the_budget_has_a_bar_for_each_source(found: Diagnosis):
    rows = budget_rows(replace(found, budget=LINES, named=(SimpleNamespace(name="backlash"),)), "mm")
    assert [row.source for row in rows] == ["backlash", "sensor noise", "smooth, unnamed", "others"]
    assert [row.share for row in rows] == pytest.approx([60, 30, 9.5, 0.5])
    assert [row.told for row in rows] == ["60 %, 12 µm", "30 %, 6 µm", "10 %, 4 µm", "< 1 %, 1 µm"]
    assert [row.kind.split()[0] for row in rows] == ["named", "noise,", "repeats,", "noise,"]


def test_without_a_budget_the_mean_square_is_shared(found: Diagnosis):
    rows = budget_rows(replace(found, budget=()), "mm")
    assert sum(row.share for row in rows) == pytest.approx(100)
    noise = next(row for row in rows if row.source == "sensor noise")
    assert noise.share == pytest.approx(100 * min(1.0, (found.noise_floor / found.residual_rms) ** 2))


def test_the_scanners_map_is_centred_on_zero_and_empty_without_points(found: Diagnosis, field: FieldMap):
    shown = replace(found, scanner_error=FieldError(0.02, 0.0, 9.0, over_noise=True, map=field))
    (told,) = [one for one in diagnosis_plots(shown, "mm") if "scanner errs" in one.title]
    error, sigma = told.plots
    assert (error["low"], error["high"]) == pytest.approx((-40, 40)) and sigma["high"] == pytest.approx(3)
    assert error["values"][0][0] is None and sum(v is None for row in error["values"] for v in row) == 1
    # x/z of 0.4 is 21.8°.
    assert error["x"][-1] == pytest.approx(np.degrees(np.arctan(0.4)), abs=0.01)
    assert "23 µm rms" in told.caption and "3 µm" in told.caption


def test_a_joints_course_is_drawn_with_two_sigmas_where_views_stood(found: Diagnosis):
    angle, error = np.array([-60.0, 0.0, 40.0]), np.array([-1e-4, 0.0, 2.5e-4])
    course = JointCurve(2, "j3_deg", 0.8, angle, error, np.full(3, 1e-5), view_values=angle, place="joint 2")
    told = diagnosis_plots(replace(found, curves=(course,)), "mm")[0].plots[0]
    band, line, ticks = told["series"]
    assert line["y"] == [-0.1, 0.0, 0.25] and band["sigma"] == [0.01] * 3 and ticks["x"] == [-60.0, 0.0, 40.0]
    assert told["x"]["label"].startswith("j3 (°): 80 %") and told["y"]["label"] == "joint 2 off by (mrad)"

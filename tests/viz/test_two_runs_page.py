"""Two runs side by side: hand-eyes with their uncertainty, refusals, the sentence, the page."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.two_runs import HandEyeChange, compare_runs, comparison_sentence
from tests.command_line import ended
from tests.in_browser import WAYS, require_for_everybody, shown
from viz.two_runs_page import facts, view_change_rows, write_two_runs

# A turn of 2 mrad and a shift of 0.3 mm, in the scanner frame of A.
MOVED = np.array([0.002, 0.0, 0.0, 0.0, 0.3, 0.0])


@pytest.fixture(scope="module")
def pair(recorded):
    """A run, and one whose hand-eye is another, known better."""
    a = recorded[0]
    b = replace(a, model=replace(a.model, T_mount=a.T_mount @ frames.exp(MOVED), covariance=0.04 * a.mount_covariance))
    return a, b


@pytest.fixture(scope="module")
def file(pair, tmp_path_factory):
    path = tmp_path_factory.mktemp("two") / "two.html"
    write_two_runs(compare_runs(pair, ("before", "after <2>")), path, tolerance=0.1)
    return path


@pytest.fixture(scope="module")
def page(file):
    return file.read_text(encoding="utf-8")


def test_the_difference_of_two_hand_eyes_scatters_as_its_covariance_says(pair):
    """Both drawn 20,000 times by their own covariances; the variance of a sample is known to 1 %, five of them."""
    a, b = pair
    change = HandEyeChange(a, b)
    np.testing.assert_allclose(change.twist, MOVED, atol=1e-12)
    draws = np.random.default_rng(1)
    own = [draws.multivariate_normal(np.zeros(6), x.mount_covariance, 20_000) for x in (a, b)]
    drawn = frames.inverse(a.T_mount @ frames.exp(own[0])) @ (b.T_mount @ frames.exp(own[1]))
    scatter = frames.log(drawn @ frames.inverse(frames.exp(MOVED)))
    np.testing.assert_allclose(change.U, 2 * scatter.std(axis=0), rtol=0.05)
    # At the part: the same draws move its points.
    points = np.vstack([view.cloud.points[::50] for view in b.session.views])
    moved = np.array([frames.transform(frames.exp(x), points) - points for x in scatter[:400]])
    assert change.U_at_part == pytest.approx(2 * np.sqrt((moved**2).sum(axis=2).mean()), rel=0.2)
    apart = frames.transform(frames.exp(MOVED), points) - points
    assert change.at_part == pytest.approx(np.sqrt((apart**2).sum(axis=1).mean()), rel=0.02)
    expected = chi2.sf(MOVED @ np.linalg.inv(np.cov(scatter.T)) @ MOVED, 6)
    assert change.p_value == pytest.approx(expected, abs=0.05)


def test_runs_whose_numbers_mean_other_things_are_refused(recorded):
    run = recorded[0]
    others = {
        "length_unit is mm in the one and m": replace(run, session=replace(run.session, length_unit="m")),
        "mount is eye_to_hand in the one and eye_in_hand": replace(
            run, session=replace(run.session, mount="eye_in_hand")
        ),
        "surfaces in the one and labelled points alone": run.with_fit(registered=None),
    }
    for words, other in others.items():
        with pytest.raises(InputError, match=f"x and y cannot be compared: .*{words}.*to fix"):
            compare_runs((run, other), ("x", "y"))


def test_the_sentence_says_what_changed_and_whether_the_data_did(pair, tmp_path):
    a, b = pair
    same = comparison_sentence(compare_runs((a, a), ("a", "a")))
    assert same.startswith("With the same effects in the model, the views of B disagree as far as those of A, by")
    assert same.endswith("Both have the same hand-eye.")
    elsewhere = replace(b, session=replace(b.session, path=tmp_path))
    both = compare_runs((a, elsewhere), ("a", "b"))
    assert not both.same_data
    before, after = (f"{1e3 * model_history(x).models[-1].field.mean_abs:.3g} µm" for x in (a, b))
    assert f"on other data, the views of B disagree by {after} instead of {before}" in comparison_sentence(both)
    assert [row.name for row in facts(both) if row.differs] == ["data (SHA-256)"]


def test_views_stand_by_how_much_they_changed(pair):
    both = compare_runs(pair, ("a", "b"))
    rows = view_change_rows(both)
    off = [model_history(run).models[-1].field.values for run in pair]
    names = [view.name for view in pair[0].session.views]
    change = {n: 1e3 * (np.nanmean(np.abs(y)) - np.nanmean(np.abs(x))) for n, x, y in zip(names, *off, strict=True)}
    assert {row["view"]: pytest.approx(row["change"]) for row in rows} == change
    sizes = [abs(row["change"]) for row in rows]
    assert sizes == sorted(sizes, reverse=True)


def test_the_page_needs_nothing_beside_it_and_has_one_scale(page):
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert not re.search(r"https?:|@import|fetch\(|XMLHttpRequest|WebSocket|import\(", page)
    assert len(page.encode()) < 8_000_000
    assert "A: before" in page
    assert "B: after &lt;2&gt;" in page
    data = [json.loads(re.search(f'id="part-{x}-data">(.*?)</script>', page, re.S)[1]) for x in "ab"]
    assert data[0]["full"] == data[1]["full"]
    assert (data[0]["size"], data[0]["centre"]) == (data[1]["size"], data[1]["centre"])
    assert data[0]["steps"][-2]["mean"] < data[1]["steps"][-2]["mean"]


@pytest.mark.slow
def test_what_turns_the_one_part_turns_the_other(browser, file):
    page, asked, wrong = shown(browser, file, "light")
    one, other = page.locator("#part-a canvas"), page.locator("#part-b canvas")
    before = other.screenshot()
    one.focus()
    for _ in range(4):
        page.keyboard.press("ArrowLeft")
    page.wait_for_function(
        "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
    )
    assert other.screenshot() != before
    page.locator("#part-a select").select_option(index=1)
    names = [page.locator(f"#part-{x} select option:checked").inner_text() for x in "ab"]
    assert names[0] == names[1] != "all views together"
    assert (asked, wrong) == ([], [])
    page.close()


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_everybody_can_read_and_reach_the_page(browser, file, way):
    require_for_everybody(browser, file, way)


def test_bad_folders_end_in_one_line(tmp_path):
    for words, told in (
        (["report", tmp_path, tmp_path / "none"], "damaged|no such run folder|name a run folder"),
        (["report", tmp_path, tmp_path], "are one run"),
        (["report", tmp_path, "-o", tmp_path / "x.html"], "the page of one run"),
        (
            ["report", tmp_path, tmp_path / "b", "--no-diagnosis"],
            "^stitch: --no-diagnosis: .*to fix: leave --no-diagnosis",
        ),
        (["report", tmp_path, tmp_path / "b", "--diagnosis"], "^stitch: --diagnosis: .*to fix: leave --diagnosis"),
    ):
        error = ended(*words, code=2).err
        assert re.search(told, error)
        assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())

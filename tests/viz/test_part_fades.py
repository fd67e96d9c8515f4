"""The part on the page fades once from the first model to the present one, as it is drawn in a browser."""

import json
import re
from itertools import pairwise

import pytest

from viz.run_page import write_report

_DATA = re.compile(r'(id="part-data">)(.*?)(</script>)', re.S)
_LASTS_MS = 700
_SAMPLED = """() => {
  window.seen = [];
  const slider = document.querySelector('#part input[type=range]');
  const look = now => { window.seen.push([Number(slider.value), now]); requestAnimationFrame(look); };
  requestAnimationFrame(look);
}"""


@pytest.fixture(scope="module")
def page_after_an_effect(recorded, tmp_path_factory):
    """A page with one more step, whose field is that of register: the data of a run to which an effect was added."""
    path = tmp_path_factory.mktemp("fading") / "r.html"
    write_report(recorded[0], path)
    text = path.read_text(encoding="utf-8")
    data = json.loads(_DATA.search(text)[2])
    data["steps"].insert(2, {**data["steps"][-1], "name": "+ backlash"})
    for view in data["views"]:
        view["means"].insert(2, view["means"][-1])
        view["steps"].insert(2, view["steps"][-1])
    data["end"] = 2
    path.write_text(_DATA.sub(lambda found: found[1] + json.dumps(data) + found[3], text), encoding="utf-8")
    return path


def opened(browser, path, **options):
    page = browser.new_page(viewport={"width": 900, "height": 500}, **options)
    page.goto(path.as_uri(), timeout=120_000)
    page.wait_for_selector("#part.live")
    return page


def at(page):
    return page.evaluate("Number(document.querySelector('#part input[type=range]').value)")


def drawn(page):
    """The part as it is seen."""
    canvas = page.locator("#part canvas")
    canvas.scroll_into_view_if_needed()
    page.wait_for_timeout(1000)
    return canvas.screenshot()


def test_it_waits_until_the_part_is_in_sight_then_runs_evenly_to_the_present_model(browser, page_after_an_effect):
    page = opened(browser, page_after_an_effect)
    page.wait_for_timeout(1500)
    assert at(page) == 1
    page.evaluate(_SAMPLED)
    page.locator("#part canvas").scroll_into_view_if_needed()
    page.wait_for_function("window.seen.at(-1)[0] === 2", timeout=30_000)
    seen, times = zip(*page.evaluate("window.seen"), strict=True)
    assert list(seen) == sorted(seen) and seen[0] == 1
    # A machine so busy that it draws nothing for as long as the fade lasts shows none of it.
    assert any(1 < place < 2 for place in seen) or max(b - a for a, b in pairwise(times)) > _LASTS_MS / 2
    assert page.locator("#part [data-title]").inner_text().startswith("+ backlash")
    assert page.locator("#part [data-steps] button[aria-pressed=true]").inner_text() == "+ backlash"
    still = opened(browser, page_after_an_effect, reduced_motion="reduce")
    assert drawn(page) == drawn(still)
    page.close()
    still.close()


def test_it_stands_still_where_less_motion_is_asked_for_and_both_ends_are_drawn(browser, page_after_an_effect):
    page = opened(browser, page_after_an_effect, reduced_motion="reduce")
    assert at(page) == 2
    shots = []
    for name in ("+ backlash", "hand-eye alone", "+ backlash"):
        page.get_by_role("button", name=name, exact=True).click()
        shots.append(drawn(page))
    assert shots[0] == shots[2] != shots[1]
    page.close()


def test_grey_is_explained_beside_the_part(browser, page_after_an_effect):
    """In the same window as the colours, however low it is."""
    page = opened(browser, page_after_an_effect, reduced_motion="reduce")
    grey = page.locator("#part [data-bar] small")
    assert grey.inner_text() == "seen by one view only"
    page.locator("#part select").select_option(index=1)
    assert grey.inner_text() == "nothing to compare with"
    page.close()

"""Pages as a browser shows them: whether everybody can read and reach what is there, and what it asks for."""

from pathlib import Path

import pytest

# A software renderer draws the part where there is no graphics card.
DRAWN = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
# Without motion: every frame of it takes a processor a tenth of a second.
WAYS = {
    "light": {"viewport": {"width": 1100, "height": 900}, "reduced_motion": "reduce"},
    "dark": {"viewport": {"width": 1100, "height": 900}, "color_scheme": "dark", "reduced_motion": "reduce"},
    "phone": {"viewport": {"width": 390, "height": 800}, "reduced_motion": "reduce"},
}
_UNFOLD = "() => document.querySelectorAll('details').forEach(details => { details.open = true; })"


def barriers(page):
    """What axe-core finds against WCAG and good practice on an open page, unfolded: rule and first place of each.

    Skips where axe-core is not installed.
    """
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-core checks the pages").Axe()
    page.evaluate(_UNFOLD)
    found = axe.run(page).response["violations"]
    return [(rule["id"], rule["nodes"][0]["html"][:200], rule["nodes"][0]["failureSummary"]) for rule in found]


def shown(browser, path: Path, way: str):
    """A page of a file, opened; what it asked for beside itself, and what went wrong on its console."""
    page, asked, wrong, own = browser.new_page(**WAYS[way]), [], [], ("data:", path.resolve().as_uri())
    page.on("request", lambda request: None if request.url.startswith(own) else asked.append(request.url))
    page.on("console", lambda told: wrong.append(told.text) if told.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(path.resolve().as_uri(), timeout=120_000)
    return page, asked, wrong


def require_for_everybody(browser, path: Path, way: str) -> None:
    """A page has no barrier, fits the window, asks for nothing and does nothing wrong."""
    page, asked, wrong = shown(browser, path, way)
    try:
        assert barriers(page) == []
        assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth")
        assert (asked, wrong) == ([], [])
    finally:
        page.close()

"""The site: every page has its place in the order of mkdocs.yml, every link leads to a page or a picture of it."""

import posixpath
import re

import pytest

from bench.docs.site_pages import ROOT, pages


@pytest.fixture(scope="module")
def site():
    """Every page by its path."""
    return pages()


def test_every_page_has_its_place(site):
    order = re.findall(r"([\w.-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(order) == sorted(name for name in site if not name.startswith("source/"))


def test_every_link_stays_in_the_site(site):
    for name, text in site.items():
        if name.startswith("source/"):
            continue
        prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
        for link in re.findall(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"", prose):
            path, _, anchor = "".join(link).partition("#")
            if path.startswith("data:"):
                continue
            target = posixpath.normpath(posixpath.join(posixpath.dirname(name), path)) if path else name
            assert target in site or (ROOT / "docs" / target).is_file(), f"{name}: {path}"
            assert not anchor or anchor in anchors(site[target]), f"{name}: {path}#{anchor}"


def anchors(page):
    headings = re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    return {re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


def test_the_reference_has_every_command_effect_and_function(site):
    import typer

    import stitch
    from stitch.cli.main import build
    from stitch.effects import EFFECTS

    commands = typer.main.get_command(build()).commands
    assert not [name for name in commands if f"## `stitch {name}`" not in site["cli.md"]]
    assert not [name for name in EFFECTS if f"| `{name}` |" not in site["effects-table.md"]]
    assert not [name for name in stitch.__all__ if f".{name}\n" not in site["python-reference.md"]]

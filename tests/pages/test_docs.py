"""The pages say what is there: paths, names, commands, the walk of a cloud."""

import re
import sys
import threading
from pathlib import Path

import pytest

import stitch
from stitch.output.run_folder import write_with_page
from stitch.system import threads

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLDERS = ("stitch", "viz", "data_synth", "bench", "tests", "docs", "examples")
# Files of somebody's own, of sessions and of run folders.
OTHERS = {
    "mine.py",
    "review_effects.py",
    "line/window.toml",
    "line/body.toml",
    "line/seam.toml",
    "session.toml",
    "model.toml",
    "robot.toml",
    "my-cell.toml",
    "job.toml",
    "stand.toml",
    "FEATURES.toml",
    "artefact.toml",
}
# Words that the glossary replaces.
PRIVATE = re.compile(r"\bsuspects?\b|look-?alikes?|\bmend(s|ed)?\b|\bgross errors?\b", re.IGNORECASE)


@pytest.fixture(scope="module")
def paths() -> list[str]:
    """Every file of the project's folders, from its root."""
    files = (file for folder in FOLDERS for file in (ROOT / folder).rglob("*") if "__pycache__" not in file.parts)
    return [str(file.relative_to(ROOT)) for file in files]


@pytest.fixture(scope="module")
def code(paths) -> set[str]:
    """Every word of the code, of the packaging and of the tables in it."""
    files = [ROOT / path for path in paths if path.endswith((".py", ".toml", ".j2", ".csv"))]
    files += [ROOT / "pyproject.toml", ROOT / "Makefile"]
    return {word for file in files for word in re.findall(r"\w+", file.read_text(encoding="utf-8"))}


def quoted(page: Path) -> list[str]:
    """Everything in single backticks, outside blocks of code."""
    return re.findall(r"`([^`\n]+)`", without_blocks(page))


def without_blocks(page: Path) -> str:
    """A page without its blocks of code and output."""
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_and_link_of_a_page_exists(page, paths):
    named = {path for text in quoted(page) for path in re.findall(r"[\w/-]+\.(?:py|toml)\b", text)}
    gone = [p for p in named if p not in OTHERS and not any(f == p or f.endswith(f"/{p}") for f in paths)]
    assert not gone
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_name_of_a_page_is_in_the_code(page, code):
    names = [text for text in quoted(page) if re.fullmatch(r"[A-Za-z_][\w.]*(\(\))?", text)]
    assert not [name for name in names if name.rstrip("()").split(".")[-1] not in code]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_use_the_field_s_words(page):
    text = without_blocks(page).split("## How things are said")[0]
    assert not [found.group() for found in PRIVATE.finditer(text)]


def test_every_function_and_form_of_the_walks_is_in_the_file_that_it_links_to():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for name, file in re.findall(r"\[`(\w+)`\]\(\.\./([\w/]+\.py)\)", text):
        assert re.search(rf"^(def|class) {name}\b", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), name
    forms = text.split("## The walk of one parameter")[1].split("\n\nThe way back")[0]
    assert len(re.findall(r"^\| ", forms, re.MULTILINE)) - 1 <= 8


def test_rooms_of_the_pages_are_those_of_the_tree():
    rooms = {
        path.name for path in (ROOT / "stitch").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    architecture = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for room in rooms - {"__init__.py"}:
        assert f"(../stitch/{room})" in architecture, room


def test_a_cloud_walks_as_the_page_says(session, tmp_path):
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    walk = re.findall(r"^\d+\. \[`(\w+)`\]\(\.\./(\S+)\)", page.split("<!-- walk: end -->")[0], re.MULTILINE)
    assert len(walk) <= 12
    places, seen = {(name, str(ROOT / file)) for name, file in walk}, []

    def watch(frame, event, _):
        if event == "call" and (place := (frame.f_code.co_name, frame.f_code.co_filename)) in places:
            seen.append(place)

    threads._pool.cache_clear()  # only threads that begin now are watched
    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        write_with_page(stitch.run(stitch.load_session(session)), tmp_path)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    calls = iter(seen)
    for name, file in walk:
        assert (name, str(ROOT / file)) in calls, f"{name} was not called after the ones before it"

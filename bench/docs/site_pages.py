"""Put the site's pages into build/docs, from which `make docs` builds it: python -m bench.docs.site_pages.

README.md is the first page, CHANGELOG.md another; the reference and the notebook's page are made from the code; and
every source file that a page links to gets a page of its own, so that no link of the site leads out of it.
"""

import os
import re
import shutil
from pathlib import Path

from bench.docs.notebook_page import NOTEBOOKS, notebook_page
from bench.docs.reference_pages import commands_page, effects_page, python_page

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "build" / "docs"
# Pages whose place in the project is another one than in the site.
MOVED = {"README.md": "index.md", "CHANGELOG.md": "changes.md"}
MOVED |= {file.relative_to(ROOT).as_posix(): f"{file.name}.md" for file in NOTEBOOKS}
_LINK = re.compile(r'(?<=\]\()([^)\s#:]+)(#[^)\s]*)?(?=\))|(?<=src=")([^":]+)(?=")')
_LANGUAGES = {".py": "python", ".toml": "toml"}


def pages() -> dict[str, str]:
    """Every page of the site by its path there."""
    made = {
        "index.md": _in_docs(ROOT / "README.md"),
        "changes.md": _in_docs(ROOT / "CHANGELOG.md"),
        "cli.md": commands_page(),
        "effects-table.md": effects_page(),
        "python-reference.md": python_page(),
    }
    made |= {f"{file.name}.md": notebook_page(file) for file in NOTEBOOKS}
    made |= {page.name: _in_docs(page) for page in sorted((ROOT / "docs").glob("*.md"))}
    linked = sorted({path for text in made.values() for path in re.findall(r"\(source/([^)#]+)\.md\)", text)})
    sources = {f"source/{path}.md": _source_page(ROOT / path) for path in linked}
    return made | {"source.md": _all_sources(linked)} | sources


def main() -> None:
    """Write them, and the pictures, into a new folder."""
    shutil.rmtree(OUT, ignore_errors=True)
    shutil.copytree(ROOT / "docs" / "pictures", OUT / "pictures")
    shutil.copyfile(ROOT / "docs" / "site.css", OUT / "site.css")
    for name, text in pages().items():
        file = OUT / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")


def _in_docs(page: Path) -> str:
    return _linked(page.read_text(encoding="utf-8"), page)


def _linked(text: str, page: Path) -> str:
    """A page's text with the links of its place in the project turned into those of the site."""

    def turned(found: re.Match[str]) -> str:
        path, anchor = found[1] or found[3], found[2] or ""
        target = Path(os.path.normpath(page.parent / path))
        if not target.exists():
            return found[0]
        name = target.relative_to(ROOT).as_posix()
        inside = MOVED.get(name) or (name.removeprefix("docs/") if name.startswith("docs/") else f"source/{name}.md")
        return inside + anchor

    return _LINK.sub(turned, text)


def _source_page(path: Path) -> str:
    """A file as a page; of a folder what lies in it, each with the first line of what it says of itself."""
    name = path.relative_to(ROOT).as_posix()
    if path.is_file():
        language = _LANGUAGES.get(path.suffix, "text")
        text = path.read_text(encoding="utf-8")
        return f"---\nsearch: {{exclude: true}}\n---\n# {name}\n\n````{language}\n{text}````\n"
    rows = [f"| `{p.relative_to(path)}` | {_first_line(p)} |" for p in sorted(path.rglob("*.py")) if _first_line(p)]
    table = "\n".join(["| file | what it is |", "|---|---|", *rows])
    return f"# {name}\n\n{_first_line(path / '__init__.py')}\n\n{table}\n"


def _first_line(file: Path) -> str:
    found = re.match(r'"""(.*?)(?:"""|\n)', file.read_text(encoding="utf-8")) if file.is_file() else None
    return found[1].replace("|", "\\|") if found else ""


def _all_sources(linked: list[str]) -> str:
    rows = (f"- [{path}](source/{path}.md)" for path in linked)
    return "# Source files\n\nThose that the pages speak of.\n\n" + "\n".join(rows) + "\n"


if __name__ == "__main__":
    main()

"""The pages say what is there: paths, names, commands, the walk of a cloud, keys, formats, links; benches import what is there.

Blocks of the pages: of a kind that is known, run or left alone for a reason; every command line of `stitch` parses.
"""

import ast
import importlib
import json
import posixpath
import re
import sys
import threading
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import typer

import stitch
from bench import run as bench_run
from bench.docs.page_examples import LANGUAGES, PAGES, ROOT, blocks, refused
from bench.docs.site_pages import pages
from data_synth.fixtures.labelled_arm import DH_ROWS, labelled_cell
from stitch.api.pipeline import diagnose, run
from stitch.cli.main import build
from stitch.output.diagnosis_document import diagnosis_document
from stitch.output.result_document import ledger, result_document
from stitch.output.run_folder import write_with_page
from stitch.plugins.intake.raw_poses import PROGRAMS, STRUCTURED, TABLES
from stitch.session.reading.clouds import CLOUD_SUFFIXES
from stitch.session.reading.session_folder import load_session
from stitch.system import threads

ALL_PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
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
    "model_effects.py",
    "robot.toml",
    "my-cell.toml",
    "job.toml",
    "stand.toml",
    "FEATURES.toml",
    "artefact.toml",
}
# Words that the glossary replaces.
PRIVATE = re.compile(r"\bsuspects?\b|look-?alikes?|\bmend(s|ed)?\b|\bgross errors?\b", re.IGNORECASE)
TARGETS = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


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


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: page.name)
def test_every_path_and_link_of_a_page_exists(page, paths):
    named = {path for text in quoted(page) for path in re.findall(r"[\w/-]+\.(?:py|toml)\b", text)}
    gone = [p for p in named if p not in OTHERS and not any(f == p or f.endswith(f"/{p}") for f in paths)]
    assert not gone
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: page.name)
def test_every_name_of_a_page_is_in_the_code(page, code):
    names = [text for text in quoted(page) if re.fullmatch(r"[A-Za-z_][\w.]*(\(\))?", text)]
    assert not [name for name in names if name.rstrip("()").split(".")[-1] not in code]


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: page.name)
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


SESSION_PAGE = ROOT / "docs" / "session.md"


def test_the_session_of_the_page_is_read(session):
    (text,) = (b.text for b in blocks(SESSION_PAGE) if b.language == "toml")
    rows = ", ".join("{ " + ", ".join(f"{key} = {x}" for key, x in row.items()) + " }" for row in DH_ROWS)
    text = text.replace("[[…4],[…4],[…4],[0,0,0,1]]", json.dumps(np.eye(4).tolist()))
    text = re.sub(r"joints = \[ (\{.*?\}), … \]", rf"joints = [ \1, {rows} ]", text)
    # A radius says that every cloud shows one sphere, which a blade does not.
    text = re.sub(r"(?m)^radius = .*$", "", text)
    assert "…" not in text
    (session / "session.toml").write_text(text, encoding="utf-8")
    (session / "blade.stl").write_text("solid s\nendsolid s\n")
    found = load_session(session)
    assert found.name == "blade-17" and found.scanner.noise == 0.02 and found.repeatability.position == 0.05


def test_every_key_that_a_run_writes_stands_on_the_page(few_effects):
    cell, *_ = labelled_cell(1, views=12)
    found = run(cell)
    diagnosed = diagnosis_document(diagnose(found))
    candidates = [row | {"candidates": None} for row in diagnosed.pop("candidates")]
    named = set(re.findall(r"`([\w]+)`", SESSION_PAGE.read_text(encoding="utf-8")))
    documents = (result_document(found), *ledger(found), diagnosed, *candidates)
    missing = sorted({key for document in documents for key in document} - named)
    assert not missing


FORMATS_PAGE = ROOT / "docs" / "formats.md"


BAGS = (".bag", ".db3", ".mcap")


def rows():
    table = FORMATS_PAGE.read_text(encoding="utf-8").split("\n| file ")[1]
    return [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")][1:]


def test_every_kind_of_file_stands_in_the_table():
    named = {ending for row in rows() for ending in re.findall(r"\.[a-z0-9]+\b", row[0])}
    assert {*CLOUD_SUFFIXES, *TABLES, *STRUCTURED, *PROGRAMS, *BAGS} <= named


def test_every_row_has_its_tests():
    for row in rows():
        tests = re.findall(r"\[`(\w+)`\]\(([^)]+)\)", row[3])
        assert tests, row[0]
        for name, file in tests:
            text = (FORMATS_PAGE.parent / file).read_text(encoding="utf-8")
            assert re.search(rf"^def {name}\(", text, re.MULTILINE), f"{file} has no {name}"


OWN = {"stitch", "data_synth", "viz", "bench"}


@pytest.mark.parametrize("folder", ["bench", "examples"])
def test_what_benches_import_is_there(folder):
    lacking = []
    for file in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OWN:
                lacking += [
                    f"{file.name}: {node.module}.{a.name}" for a in node.names if not found(node.module, a.name)
                ]
    assert not lacking


def found(module, name):
    """Whether a module has a name, or a module below it."""
    try:
        return hasattr(importlib.import_module(module), name) or bool(importlib.import_module(f"{module}.{name}"))
    except ModuleNotFoundError:
        return False


@pytest.mark.parametrize("table", bench_run.TABLES)
def test_a_table_of_the_benches_stands_in_its_module(table):
    module, _, name = bench_run.TABLES[table].partition(":")
    tree = ast.parse((ROOT / "bench" / f"{module}.py").read_text(encoding="utf-8"))
    assert name in {ast.unparse(node.targets[0]) for node in tree.body if isinstance(node, ast.Assign)}


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: page.name)
def test_a_page_names_tables_of_the_benches_that_are_there(page):
    assert set(re.findall(r"bench/run\.py\s+([a-z][\w-]*)", page.read_text(encoding="utf-8"))) <= set(bench_run.TABLES)


BENCHES = "".join(file.read_text(encoding="utf-8") for file in sorted((ROOT / "bench").glob("*.py")))


@pytest.mark.parametrize(("page", "block"), re.findall(r'page="([\w-]+)",\s+block="([\w-]+)"', BENCHES))
def test_a_page_has_the_block_that_a_table_is_written_into(page, block):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    assert f"<!-- {block}: begin -->" in text and f"<!-- {block}: end -->" in text


def forms(page):
    """Command lines that are not run: in `sh` blocks, and in sentences between backticks."""
    text = page.read_text(encoding="utf-8")
    quoted = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    lines = [line for b in blocks(page) if b.language == "sh" for line in b.text.splitlines()]
    return [line.removeprefix(".venv/bin/") for line in lines], [line.replace("\\|", "|") for line in quoted]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_is_of_a_known_kind(page):
    fences = re.findall(r"^ *```(\w*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert fences[1::2] == [""] * (len(fences) // 2)
    assert not [language for language in fences[::2] if language not in LANGUAGES], f"one of {LANGUAGES}"
    # Indented blocks would slip through.
    assert not re.search(r"^    (stitch|python|make) ", page.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_form_of_a_command_parses(page):
    wrong, (lines, sentences) = {}, forms(page)
    for line in (*lines, *sentences):
        if re.match(r"stitch [a-z-]", line):
            if why := refused(line, named_only=line in sentences):
                wrong[line] = why
        elif target := re.match(r"make (\w+)", line):
            assert target[1] in TARGETS, line
        elif module := re.match(r"(?:\.venv/bin/)?python (?:-m )?(bench[\w./]+)", line):
            path = module[1] if module[1].endswith(".py") else module[1].replace(".", "/") + ".py"
            assert (ROOT / path).is_file(), line
    assert not wrong


def test_every_command_stands_on_the_page_of_commands():
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert not [name for name in typer.main.get_command(build()).commands if f"stitch {name}" not in page]


@pytest.mark.parametrize(
    "line",
    ["stitch nothing", "stitch run --no-such-option", "stitch export", "stitch calibrate globe SESSION", "stitch drop"],
)
def test_a_wrong_line_is_refused(line):
    assert refused(line)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_names_only_what_exists(page):
    """Without running it, blocks that cannot be run included."""
    for node in (node for b in blocks(page) if b.language == "python" for node in ast.walk(ast.parse(b.text))):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                assert hasattr(import_module(node.module), alias.name), f"{node.module} has no {alias.name}"
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "stitch":
            assert node.attr in stitch.__all__


@pytest.mark.parametrize("notebook", sorted((ROOT / "docs").glob("*.ipynb")), ids=lambda notebook: notebook.stem)
def test_what_a_notebook_imports_is_there(notebook):
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    code = ast.parse("\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"))
    imports = [statement for statement in code.body if isinstance(statement, ast.Import | ast.ImportFrom)]
    assert imports
    exec(compile(ast.Module(imports, []), notebook.name, "exec"), {})

"""Blocks of the pages: of a kind that is known, run or left alone for a reason; every command line of `stitch` parses."""

import ast
import re
from importlib import import_module

import pytest
import typer

import stitch
from bench.docs.page_blocks import LANGUAGES, PAGES, ROOT, blocks, refused
from stitch.cli.main import build

TARGETS = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


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

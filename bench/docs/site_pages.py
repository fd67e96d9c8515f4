"""The pages as a site: python -m bench.docs.site_pages puts them into build/docs, from which `make docs` builds it.

README.md is the first page, CHANGELOG.md another; the reference and the notebooks' pages are made from the code; and
every source file that a page links to gets a page of its own, so that no link of the site leads out of it. `python -m
bench.docs.site_pages notebooks` runs the notebooks as plain Python and writes what their cells print and draw into
docs/*.ipynb, and the picture of one for README.md.
"""

import ast
import base64
import io
import json
import os
import re
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from math import isfinite
from pathlib import Path
from typing import Any

import typer
from matplotlib.figure import Figure
from PIL import Image
from typer.cli import get_docs_for_click

import stitch
from bench.docs.page_examples import ROOT
from stitch import MODULES
from stitch.cli.effects import parameter_signature
from stitch.cli.main import build
from stitch.effects import EFFECTS
from stitch.effects.contract import PLACES

NOTEBOOK, PICTURE = ROOT / "docs" / "error-falls.ipynb", ROOT / "docs" / "pictures" / "error-falls.png"
NOTEBOOKS = (NOTEBOOK, ROOT / "docs" / "from-arrays.ipynb")
OUT = ROOT / "build" / "docs"
# Pages whose place in the project is another one than in the site.
MOVED = {"README.md": "index.md", "CHANGELOG.md": "changes.md"}
MOVED |= {file.relative_to(ROOT).as_posix(): f"{file.name}.md" for file in NOTEBOOKS}
_LINK = re.compile(r'(?<=\]\()([^)\s#:]+)(#[^)\s]*)?(?=\))|(?<=src=")([^":]+)(?=")')
_LANGUAGES = {".py": "python", ".toml": "toml"}
_DPI, _COLOURS = 110, 256


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
    match = re.match(r'"""(.*?)(?:"""|\n)', file.read_text(encoding="utf-8")) if file.is_file() else None
    return match[1].replace("|", "\\|") if match else ""


def _all_sources(linked: list[str]) -> str:
    rows = (f"- [{path}](source/{path}.md)" for path in linked)
    return "# Source files\n\nThose that the pages speak of.\n\n" + "\n".join(rows) + "\n"


def commands_page() -> str:
    """Every command with its arguments and options, as its help has them."""
    group = typer.main.get_command(build())
    context = typer.Context(group, info_name="stitch")
    parts = ["# Commands and options\n\nMade from the commands themselves: `stitch COMMAND --help` says the same.\n"]
    for name in sorted(group.commands):
        text = get_docs_for_click(obj=group.commands[name], ctx=context, indent=1, name=name, call_prefix="stitch")
        parts.append(_examples_as_block(text))
    return "\n".join(parts)


def effects_page() -> str:
    """The library of effects."""
    rows = [
        f"| `{e.name}` | {e.place} | {_cell(e.formula)} | {_cell(parameter_signature(e))} | {_sizes(e)} | "
        f"{', '.join(e.needs)} |"
        for e in EFFECTS.values()
    ]
    places = "\n".join(f"| `{name}` | {_cell(text)} |" for name, text in PLACES.items())
    return f"""# Effects

Made from the library: `stitch effects` lists the same. What the places mean and how to write your own:
[effects](effects.md).

| effect | place | what nature does | parameters | plausible; not believed beyond | needs |
|---|---|---|---|---|---|
{chr(10).join(rows)}

| place | the function receives → returns |
|---|---|
{places}
"""


def python_page() -> str:
    """What `import stitch` offers."""
    names = "\n\n".join(f"::: {module}.{name}" for name, module in MODULES.items())
    text = "Made from the docstrings of what `import stitch` offers; frames and units: [glossary](glossary.md)."
    return f"# Every name of Python\n\n{text} How they work together: [python](python.md).\n\n{names}\n"


def _sizes(effect: stitch.effects.contract.Effect) -> str:
    """Plausible sizes of its parameters, and beyond which they are not believed."""
    return "; ".join(
        f"{key} {spec.typical:g}{f'; {spec.limit:g}' if isfinite(spec.limit) else ''}"
        for key, spec in effect.specs.items()
    )


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _examples_as_block(text: str) -> str:
    """Indented examples of a help as a block of code."""
    return re.sub(
        r"(?m)^Examples:\n((?:  .*\n)+)",
        lambda m: "Examples:\n\n```sh\n" + re.sub(r"(?m)^  ", "", m[1]) + "```\n",
        text,
    )


def cells(file: Path) -> list[dict[str, Any]]:
    """The cells of a notebook."""
    return json.loads(file.read_text(encoding="utf-8"))["cells"]


def run_cells(file: Path) -> list[tuple[str, Any]]:
    """What every cell of code prints, and the value of its last line; no Jupyter is needed for it."""
    names: dict[str, Any] = {}
    done = []
    for cell in cells(file):
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        out = io.StringIO()
        with redirect_stdout(out), redirect_stderr(io.StringIO()):
            exec(compile(tree, file.name, "exec"), names)
            value = eval(compile(ast.Expression(last.value), file.name, "eval"), names) if last else None
        done.append((out.getvalue(), value))
    return done


def printed_in(cell: dict[str, Any]) -> str:
    """What a cell of code printed when its outputs were written."""
    return "".join(text for output in cell["outputs"] for text in output.get("text", ()))


def notebook_page(file: Path) -> str:
    """Text, code and what the code printed, as Markdown; pictures as part of the page."""
    parts = []
    for cell in cells(file):
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            if text := "".join(output.get("text", ())):
                parts.append(f"```text\n{text.rstrip()}\n```")
            elif picture := output.get("data", {}).get("image/png"):
                parts.append(f"![What the cell draws](data:image/png;base64,{''.join(picture).strip()})")
    return "\n\n".join(parts) + "\n"


def _outputs(count: int, text: str, value: Any) -> list[dict[str, Any]]:
    """Outputs of a cell as the format of notebooks has them (nbformat 4)."""
    found: list[dict[str, Any]] = []
    if text:
        found.append({"name": "stdout", "output_type": "stream", "text": text.splitlines(keepends=True)})
    if isinstance(value, Figure):
        drawn, small = io.BytesIO(), io.BytesIO()
        value.savefig(drawn, format="png", dpi=_DPI)
        Image.open(drawn).convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
        PICTURE.write_bytes(small.getvalue())
        data = {"image/png": base64.b64encode(small.getvalue()).decode()}
        found.append({"data": data, "execution_count": count, "metadata": {}, "output_type": "execute_result"})
    return found


def write_outputs() -> None:
    """Write the outputs into the notebooks."""
    for file in NOTEBOOKS:
        document = json.loads(file.read_text(encoding="utf-8"))
        code = [cell for cell in document["cells"] if cell["cell_type"] == "code"]
        for i, (cell, (text, value)) in enumerate(zip(code, run_cells(file), strict=True)):
            cell["execution_count"], cell["outputs"] = i + 1, _outputs(i + 1, text, value)
        file.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_outputs() if sys.argv[1:] == ["notebooks"] else main()

"""The notebooks of the docs: run as plain Python, written with what their cells print and draw, shown as pages.

Run: python -m bench.docs.notebook_page (writes the outputs into docs/*.ipynb, and the picture of one for README.md)
"""

import ast
import base64
import io
import json
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK, PICTURE = ROOT / "docs" / "error-falls.ipynb", ROOT / "docs" / "pictures" / "error-falls.png"
NOTEBOOKS = (NOTEBOOK, ROOT / "docs" / "from-arrays.ipynb")
_DPI, _COLOURS = 110, 256


def cells(file: Path) -> list[dict[str, Any]]:
    """The cells of a notebook."""
    found = json.loads(file.read_text(encoding="utf-8"))["cells"]
    assert isinstance(found, list)
    return found


def run_cells(file: Path) -> list[tuple[str, Any]]:
    """What every cell of code prints, and the value of its last line; no Jupyter is needed for it."""
    own: dict[str, Any] = {}
    done = []
    for cell in cells(file):
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        out = io.StringIO()
        with redirect_stdout(out), redirect_stderr(io.StringIO()):
            exec(compile(tree, file.name, "exec"), own)
            value = eval(compile(ast.Expression(last.value), file.name, "eval"), own) if last else None
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


def main() -> None:
    """Write the outputs into the notebooks."""
    for file in NOTEBOOKS:
        document = json.loads(file.read_text(encoding="utf-8"))
        code = [cell for cell in document["cells"] if cell["cell_type"] == "code"]
        for i, (cell, (text, value)) in enumerate(zip(code, run_cells(file), strict=True)):
            cell["execution_count"], cell["outputs"] = i + 1, _outputs(i + 1, text, value)
        file.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Count the lines of code and hold them against budget.toml: python bench/budget.py, as `make lint` does.

A line of code holds a token that is no comment and no docstring. A budget falls with the code: one that lies more than
a fiftieth above what is counted is refused as well.
"""

import ast
import sys
import tokenize
import tomllib
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUDGET = ROOT / "budget.toml"
# A budget may lie above the count by this share.
SLACK = 0.02
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
_NO_CODE |= {tokenize.ENCODING, tokenize.ENDMARKER}


def code_lines(file: Path) -> int:
    """Return the lines of a Python file that hold code: no blanks, comments, docstrings."""
    with file.open("rb") as source:
        tokens = [token for token in tokenize.tokenize(source.readline) if token.type not in _NO_CODE]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def script_lines(file: Path) -> int:
    """Return the lines of a script, style or template that are not blank."""
    return sum(bool(line.strip()) for line in file.read_text(encoding="utf-8").splitlines())


def count() -> dict[str, int]:
    """Return lines of code by part of the project: core, plugins, pages with nature (viz, data_synth), bench."""
    plugins = ROOT / "stitch" / "plugins"
    files = [file for part in ("stitch", "viz", "data_synth") for file in (ROOT / part).rglob("*.py")]
    stitch = [file for file in files if ROOT / "stitch" in file.parents]
    scripts = [file for file in (ROOT / "viz").rglob("*") if file.suffix in (".js", ".j2", ".css")]
    return {
        "core": _sum(file for file in stitch if plugins not in file.parents),
        "plugins": _sum(file for file in stitch if plugins in file.parents),
        "pages_and_nature": _sum(set(files) - set(stitch)) + sum(map(script_lines, scripts)),
        "bench": _sum((ROOT / "bench").rglob("*.py")),
    }


def _sum(files: Iterable[Path]) -> int:
    return sum(map(code_lines, files))


def complaints(counted: dict[str, int], budget: dict[str, int]) -> list[str]:
    """Return a sentence for each count above its budget, and for each budget that was not lowered with the code."""
    over = [f"{name}: {n} lines of code, {budget[name]} budgeted" for name, n in counted.items() if n > budget[name]]
    loose = [
        f"{name}: lower its budget in budget.toml from {budget[name]} to {n}: the code has fewer lines now"
        for name, n in counted.items()
        if budget[name] > (1 + SLACK) * n
    ]
    return over + loose


if __name__ == "__main__":
    sys.exit("\n".join(complaints(count(), tomllib.loads(BUDGET.read_text(encoding="utf-8"))["lines"])) or 0)

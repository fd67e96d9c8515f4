"""Draw the rooms of stitch from its import graph: python bench/docs/architecture.py → docs/pictures/architecture.png.

Floors come from the import rules in pyproject.toml, arrows from the imports themselves (lazy and type-checking
ones included), so that the picture cannot say what the code does not.
"""

import ast
import textwrap
import tomllib
from pathlib import Path

import grimp
import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "pictures" / "architecture.png"
WIDTH, HEIGHT, GAP = 4.6, 0.95, 0.42
EDGE, FACE, ARROW = "#34495e", "#eef3f8", "#5d6d7e"


def floors() -> list[list[str]]:
    """Rooms from the top floor down, as the import rules state them."""
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    rooms = next(rule["layers"] for rule in rules if rule.get("containers") == ["stitch"])
    return [[name.strip() for name in row.split(":")] for row in rooms]


def imports() -> set[tuple[str, str]]:
    """Pairs of rooms of which the first imports from the second."""
    graph = grimp.build_graph("stitch", include_external_packages=False)
    pairs = {(a, b) for a in graph.modules for b in graph.find_modules_directly_imported_by(a)}
    rooms = {(a.split(".")[1], b.split(".")[1]) for a, b in pairs if "." in a and "." in b}
    return {(a, b) for a, b in rooms if a != b}


def reduced(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs that do not follow from others (transitive reduction)."""
    reach = set(pairs)
    while more := {(a, d) for a, b in reach for c, d in pairs if b == c} - reach:
        reach |= more
    return {(a, b) for a, b in pairs if not any((a, c) in pairs and (c, b) in reach for c in {y for _, y in pairs})}


def purpose(room: str) -> str:
    """The first line of a room's docstring."""
    folder = ROOT / "stitch" / room / "__init__.py"
    file = folder if folder.is_file() else ROOT / "stitch" / f"{room}.py"
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.splitlines()[0].rstrip(".") if text else ""


def draw() -> None:
    """Rooms by floor; an arrow points from who imports to what is imported."""
    *rows, ground = floors()
    figure, ax = plt.subplots(figsize=(13.2, 15), dpi=90)
    places = {}
    for level, row in enumerate([*rows, ground]):
        step = (WIDTH if row is not ground else 3.1) + 0.35
        for k, room in enumerate(row):
            places[room] = ((k - (len(row) - 1) / 2) * step, -level * (HEIGHT + GAP))
    # Everything stands on the ground floor: arrows to it would say nothing.
    for a, b in sorted(reduced({(a, b) for a, b in imports() if a not in ground and b not in ground})):
        arrow(ax, places[a], places[b])
    for room, (x, y) in places.items():
        box(ax, x, y, 3.1 if room in ground else WIDTH, room)
    ax.set_xlim(-7.6, 7.6)
    ax.set_ylim(-len(rows) * (HEIGHT + GAP) - 0.7, 0.7)
    ax.axis("off")
    figure.tight_layout()
    figure.savefig(PICTURE)


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Straight to the next floor, around the rooms between to lower ones."""
    far = start[1] - end[1] > 1.5 * (HEIGHT + GAP)
    side = 1 if start[0] + end[0] >= 0 else -1
    bend = -0.35 * side if far and start[0] == end[0] else 0.0
    ax.add_patch(
        FancyArrowPatch(
            (start[0] + (WIDTH / 2.6 * side if bend else 0), start[1] - HEIGHT / 2),
            (end[0] + (WIDTH / 2.6 * side if bend else 0), end[1] + HEIGHT / 2),
            connectionstyle=f"arc3,rad={bend}",
            arrowstyle="-|>",
            mutation_scale=13,
            lw=1.3,
            color=ARROW,
            alpha=0.8,
            zorder=1,
        )
    )


def box(ax: Axes, x: float, y: float, width: float, room: str) -> None:
    """A room with its purpose."""
    corner = (x - width / 2, y - HEIGHT / 2)
    ax.add_patch(
        FancyBboxPatch(
            corner, width, HEIGHT, boxstyle="round,pad=0.02", facecolor=FACE, edgecolor=EDGE, lw=1.2, zorder=2
        )
    )
    ax.text(x, y + 0.25, room, ha="center", va="center", weight="bold", fontsize=13, zorder=3)
    lines = textwrap.wrap(purpose(room), 54 if width > 4 else 36, max_lines=2, placeholder=" …")
    ax.text(x, y - 0.2, "\n".join(lines), ha="center", va="center", fontsize=8.6, zorder=3)


if __name__ == "__main__":
    draw()

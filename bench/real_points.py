"""Labelled points of real robots: what `stitch add --suggested` finds, judged on poses left out in several ways.

Run: python bench/real_points.py [NAME...] [--at-most N] [--models ";a;a,b"] [--write]; --write puts the tables into
docs/points.md. With --models these are judged instead of what the diagnosis finds. Needs the measured data beside the
project.
"""

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.api.pipeline import run
from stitch.api.stepwise import suggest
from stitch.output.result_document import model_of
from stitch.run_data import RunData
from stitch.session.reading.session_folder import load_session
from stitch.session.session import SessionData

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data")
PAGE = ROOT / "docs" / "points.md"
MARKS = ("<!-- measured: begin -->", "<!-- measured: end -->")
# The way to leave poses out whose fitted part leads the search: odd poses of the UR10 have another elbow.
DATA = {"irb120-tracker": "even → odd", "ur10-tmac": "random halves"}
_BLOCKS = 4


def only(session: SessionData, index: np.ndarray) -> SessionData:
    """The session with the sightings of some views; the others stay, for they say from where the arm came."""
    kept = set(index.tolist())
    views = tuple(view if v in kept else replace(view, sighting=None) for v, view in enumerate(session.views))
    return replace(session, views=views)


def splits(session: SessionData) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Ways to leave poses out: pairs of views to fit on and views to judge on."""
    count = len(session.views)
    everything = np.arange(count)

    def without(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.setdiff1d(everything, index), index

    drawn = np.random.default_rng(0).permutation(count)
    turned = np.argsort([view.joints[1] for view in session.views])
    return {
        "even → odd": [(everything[::2], everything[1::2])],
        "random halves": [(np.sort(drawn[::2]), np.sort(drawn[1::2]))],
        "blocks of time": [without(block) for block in np.array_split(everything, _BLOCKS)],
        "a fifth of joint 2": [without(np.sort(turned[-(count // 5) :]))],
    }


def judged(session: SessionData, effects: list[str], way: list[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Rms and mean of the 3D distances in views that were not fitted."""
    distances = []
    for fit_on, judge_on in way:
        model = model_of(run(only(session, fit_on), effects=effects))
        found: RunData = run(only(session, judge_on), model)
        assert found.targets is not None
        d = found.targets.rows.distances(found.targets.rows.residual)
        distances.append(d[np.isfinite(d)])
    d = np.concatenate(distances)
    return float(np.sqrt(np.mean(d**2))), float(d.mean())


def suggested(session: SessionData, at_most: int, fit_on: np.ndarray) -> tuple[list[list[str]], list[str]]:
    """The way that the diagnosis takes on some poses alone, and what it says on it."""
    first = run(only(session, fit_on))
    found, lines, last = suggest(first, at_most)
    return [list(step.effects) for step in (found or first).ledger], [*lines, last.sentence]


def measure(name: str, at_most: int, models: list[list[str]] | None, target: Path) -> None:
    """Every model judged in all ways; each row is written as it comes."""
    session = load_session(SHARED / name)
    ways = splits(session)
    steps, told = (models, []) if models else suggested(session, at_most, ways[DATA[name]][0][0])
    print(name, steps, *told, sep="\n", flush=True)
    rows: list[dict[str, object]] = []
    for effects in steps:
        rows.append({"effects": effects, "judged": {n: judged(session, effects, way) for n, way in ways.items()}})
        print(name, rows[-1], flush=True)
        target.write_text(json.dumps({"name": name, "told": told, "rows": rows}, indent=1))


def table(found: dict[str, object]) -> str:
    """Markdown: a row per step, rms / mean in mm per way of leaving poses out."""
    ways = list(found["rows"][0]["judged"])
    lines = [f"**{found['name']}**: 3D distance in poses that were not fitted, rms / mean (mm)", ""]
    lines += ["| model | " + " | ".join(ways) + " |", "|---|" + "---:|" * len(ways)]
    before: set[str] = set()
    for row in found["rows"]:
        own = set(row["effects"])
        changes = [
            f"{sign} {', '.join(sorted(names))}" for sign, names in (("+", own - before), ("−", before - own)) if names
        ]
        told, before = "; ".join(changes) or "base and tool", own
        numbers = " | ".join(f"{rms:.3f} / {mean:.3f}" for rms, mean in row["judged"].values())
        lines.append(f"| {told} | {numbers} |")
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(DATA))
    parser.add_argument("--at-most", type=int, default=8)
    parser.add_argument("--models", help="effects by commas, models by semicolons; the first may be empty")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--cache", type=Path, default=ROOT / "runs" / "real_points")
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    models = [[e for e in m.split(",") if e] for m in arguments.models.split(";")] if arguments.models else None
    for name in arguments.names:
        measure(name, arguments.at_most, models, arguments.cache / f"{name}.json")
    tables = [table(json.loads(file.read_text())) for file in sorted(arguments.cache.glob("*.json"))]
    print(*tables, sep="\n")
    if arguments.write:
        begin, end = MARKS
        head, _, rest = PAGE.read_text(encoding="utf-8").partition(begin)
        text = head + begin + "\n" + "\n".join(tables) + end + rest.partition(end)[2]
        PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

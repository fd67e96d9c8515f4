"""A scanner or a part that errs by laws of no library: what is said, with clouds simulated, run and diagnosed.

Usage: python bench/scanner_laws.py FILE [--seeds 9100 9102] [--parts blade,curved_drill_plate]

Rows are appended to FILE (a JSON line each) as they come; what stands there already is not computed again; at the end
the table by law. Seeds below 9100 were used while the code was written.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from integrity_cells import MOUNTS, PARTS, measured

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import Measured
from stitch.api.pipeline import run
from stitch.diagnosis.diagnose import diagnose_state
from stitch.errors import StitchError
from stitch.system.threads import library_threads_off

# Of the points (N, 3) of one view, scanner frame, the view's number and the cell.
Law = Callable[[np.ndarray, int, Measured], np.ndarray]


def along(error: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray], growing: bool = False) -> Law:
    """Along the ray by a function (mm) of the place in the field, −1 … 1 both ways, and of the range (mm); from
    nothing to that over the session, or in every view."""

    def law(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
        range_mm = np.linalg.norm(points, axis=1)
        error_mm = error(*_field(points), range_mm) * (elapsed(v, cell) if growing else 1)
        return points + points / range_mm[:, None] * error_mm[:, None]

    return law


def everywhere(matrix: list[list[float]]) -> Law:
    """The scanner's axes by a matrix, less the identity."""
    return lambda points, v, cell: points + points @ np.array(matrix, float).T


def read_line_by_line(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """The arm still moves by 0.15 mm, elsewhere in every view, while the scanner reads from one edge to the other."""
    way = np.random.default_rng([v, len(points)]).standard_normal(3)
    return points + 0.15 * _field(points)[1][:, None] * way / np.linalg.norm(way)


def bending(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """The part bends by 0.2 mm at its ends over the session, as a clamp gives way."""
    T = cell.T_reference_scanner[v]
    at = points @ T[:3, :3].T + T[:3, 3]
    along_x = (at[:, 0] - np.median(at[:, 0])) / (0.5 * np.ptp(cell.mesh.vertices[:, 0]))
    return points + 0.2 * elapsed(v, cell) * (along_x**2)[:, None] * T[2, :3]


def elapsed(v: int, cell: Measured) -> float:
    """Share of the session."""
    return float((cell.times[v] - cell.times[0]) / np.ptp(cell.times))


def _field(points: np.ndarray) -> np.ndarray:
    """(2, N) place in the field."""
    field = points[:, :2] / points[:, 2:]
    return np.asarray((field / np.quantile(np.abs(field), 0.98)).T)


LAWS: dict[str, Law] = {
    "nothing": lambda points, v, cell: points,
    "z longer by 0.3 %": everywhere([[0, 0, 0], [0, 0, 0], [0, 0, 0.003]]),
    "x longer by 0.3 %": everywhere([[0.003, 0, 0], [0, 0, 0], [0, 0, 0]]),
    "x and y askew by 3 mrad": everywhere([[0, 0.003, 0], [0, 0, 0], [0, 0, 0]]),
    "focus tilted, 80 µm": along(lambda a, b, r: 0.08 * a * b),
    "coma, 60 µm": along(lambda a, b, r: 0.06 * a**3),
    "seam in the field, ±60 µm": along(lambda a, b, r: 0.06 * np.sign(a)),
    "ripple over the field, 40 µm": along(lambda a, b, r: 0.04 * np.sin(5 * np.pi * a)),
    "ripple over the range, 40 µm": along(lambda a, b, r: 0.04 * np.sin(2 * np.pi * r / 12)),
    "one corner off, 150 µm": along(lambda a, b, r: 0.15 * np.exp(-((a - 0.6) ** 2 + (b - 0.5) ** 2) / 0.08)),
    "focus tilts by 150 µm over the session": along(lambda a, b, r: 0.15 * a * b, growing=True),
    "read line by line, 150 µm": read_line_by_line,
    "the part bends by 0.2 mm": bending,
}


def said(m: Measured, law: Law) -> dict[str, Any]:
    """Verdict and names for one cell."""
    clouds = [replace(c, points=law(c.points, v, m)) for v, c in enumerate(m.clouds)]
    try:
        found = diagnose_state(run(session_of(replace(m, clouds=clouds))))
    except StitchError as error:
        return {"verdict": "refused", "names": [], "said": str(error)}
    kept = {
        "field": found.follows_field or found.scanner_error is not None,
        "changing": found.scanner_error is not None and found.scanner_error.by_view,
        "within": bool(found.overlap_misfit),
        "rms": found.residual_rms,
        "noise": found.noise_floor,
    }
    return {"verdict": found.verdict, "names": list(found.effects)} | kept


def rows(parts: list[str], seeds: range, known: set[str]) -> Iterator[dict[str, Any]]:
    """All cells in turn."""
    for seed in seeds:
        for part in parts:
            for mount in MOUNTS:
                m = None
                for name, law in LAWS.items():
                    if (key := f"{part} {mount} {seed} {name}") not in known:
                        m = m or measured(part, mount, seed)
                        yield {"key": key, "law": name} | said(m, law)


def table(found: list[dict[str, Any]]) -> Iterator[str]:
    """By law: what was said."""
    by_law = defaultdict(list)
    for row in found:
        by_law[row["law"]].append(row)
    yield (
        "| the scanner errs by | cells | adequate | unknown | … the scans said | … every view by itself | one name | "
        "a group | refused |"
    )
    yield "|---|---:|---:|---:|---:|---:|---:|---:|---:|"
    for law, own in by_law.items():
        counts = [
            sum(r["verdict"] == "adequate" for r in own),
            sum(r["verdict"] == "unknown_effect" for r in own),
            sum(bool(r.get("field")) for r in own),
            sum(bool(r.get("changing")) for r in own),
            *(sum(r["verdict"] == v for r in own) for v in ("missing_effect", "cannot_tell", "refused")),
        ]
        yield f"| {law} | {len(own)} | " + " | ".join(map(str, counts)) + " |"


def main() -> None:
    """Run what is not there yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=(9100, 9102))
    parser.add_argument("--parts", default=",".join(PARTS))
    asked = parser.parse_args()
    found = [json.loads(line) for line in asked.file.read_text().splitlines()] if asked.file.exists() else []
    with library_threads_off(), asked.file.open("a") as out:
        for row in rows(asked.parts.split(","), range(*asked.seeds), {row["key"] for row in found}):
            print(row["key"], row["verdict"], *row["names"], flush=True)
            print(json.dumps(row), file=out, flush=True)
            found.append(row)
    print("\n".join(table(found)))


if __name__ == "__main__":
    main()

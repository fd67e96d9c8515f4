"""Do two halves of the views of real scans agree within U? The second table of docs/measure.md.

Run: python bench/feature_halves.py PATH_OF_REGHEC_SESSIONS PATH_OF_A_SPHERE_SESSION

Every object is stitched twice, from disjoint halves of its views, each with a hand-eye of its own. Patches that both
halves see, and the distances between them, are measured in both. E_n is the difference over the root of both U².

The sphere's diameter is fitted to laser lines of the other session, with the hand-eye, against the one that it states.
"""

import sys
from pathlib import Path

import numpy as np

from stitch.api.pipeline import run
from stitch.errors import NoResultError
from stitch.numerics.frames import Array
from stitch.plugins.metrology.budget import fit_features, measure_features
from stitch.plugins.metrology.calibrate.sphere import calibrate_sphere
from stitch.plugins.metrology.error_sources import place_errors
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.features import Feature
from stitch.plugins.metrology.place_errors import PlaceErrors
from stitch.session.reading.session_folder import load_session

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measure.md"
BEGIN, END = "<!-- halves: begin -->", "<!-- halves: end -->"
OBJECTS = ("cone", "david", "rubik", "sphere", "gripperopen")
PATCHES, RADIUS = 12, 4.0  # mm


def main(folder: Path, lines_of_a_sphere: Path) -> None:
    lines = [
        "| object | points | E_n ≤ 1 | distances | E_n ≤ 1 | U of a distance, median (µm) |",
        "|---|---|---|---|---|---|",
    ]
    totals = np.zeros(4, int)
    for name in OBJECTS:
        try:
            counts, U = _object(folder / name)
        except NoResultError as error:
            lines.append(f"| {name} | – | {error} | – | – | – |")
            continue
        totals += counts
        lines.append(f"| {name} | {counts[0]} | {counts[1]} | {counts[2]} | {counts[3]} | {1e3 * U:.0f} |")
        print(lines[-1], flush=True)
    lines.append(f"| all | {totals[0]} | {totals[1]} | {totals[2]} | {totals[3]} | |")
    lines += ["", _sphere_sentence(lines_of_a_sphere)]
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(BEGIN)[0] + BEGIN + "\n" + "\n".join(lines) + "\n" + END + page.split(END)[1])


def _object(folder: Path) -> tuple[Array, float]:
    """Return points, those that agree, distances, those that agree; and U of a distance."""
    session = load_session(folder)
    halves = [place_errors(run(session.without(session.names[i::2]))) for i in (1, 0)]
    patches = _common_patches(*halves)
    names = [p.name for p in patches]
    pairs = [(a, b) for i, a in enumerate(names) for b in names[:i]]
    distances = [Feature(f"{a}-{b}", "distance", between=(a, b)) for a, b in pairs]
    one, other = (measure_features(half, FeatureList((*patches, *distances))).numbers for half in halves)
    E_n = np.array([(a.value - b.value) / np.hypot(a.U, b.U) for a, b in zip(one, other, strict=True)])
    first, rest = np.abs(E_n[: len(names)]), np.abs(E_n[len(names) :])
    counts = np.array([len(first), (first <= 1).sum(), len(rest), (rest <= 1).sum()])
    return counts, float(np.median([n.U for n in one[len(names) :]]))


def _sphere_sentence(folder: Path) -> str:
    session = load_session(folder)
    fit = calibrate_sphere(session).free
    diameter, U, stated = 2 * fit.radius, 4 * np.sqrt(fit.covariance[9, 9]), 2 * (session.sphere_radius or np.nan)
    return (
        f"A real sphere of {stated:g} mm under {len(session.views)} laser lines of a FANUC arm: its diameter is "
        f"{diameter:.2f} mm with U = {U:.2f} mm, E_n = {abs(diameter - stated) / U:.2f}\n"
        "(`stitch calibrate sphere --radius-free`). The lines pass near its equator and hardly turn, which U says."
    )


def _common_patches(one: PlaceErrors, other: PlaceErrors) -> list[Feature]:
    """Return patches spread over the part that both halves see with many points."""
    points, rng, found = one.points, np.random.default_rng(0), list[Feature]()
    for k in rng.permutation(len(points.points)):
        at = points.points[k]
        if any(np.linalg.norm(at - f.at) < 4 * RADIUS for f in found):
            continue
        patch = Feature(f"p{len(found) + 1}", "point", at=at, axis=points.normals[k], radius=RADIUS, within=RADIUS)
        try:
            fits = [fit_features(half.points, [patch])[0] for half in (one, other)]
        except NoResultError:
            continue
        if min(len(fit.residual) for fit in fits) >= 100:
            found.append(patch)
        if len(found) == PATCHES:
            break
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

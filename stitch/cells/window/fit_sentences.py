"""What a fit found, in sentences: the same on the terminal, on the page and in the recording."""

from collections.abc import Iterator

import numpy as np

from stitch.cells.pose_table import rows_from_poses
from stitch.cells.window.allowance import allowance_sentence
from stitch.cells.window.window_jobs import FitJob
from stitch.cells.window.window_solution import FittedPart
from stitch.units import uncertainty_text

NO_UNIT = "Lengths in the unit of the CAD, whose file names none; length_unit in the job states it."


def with_unit(job: FitJob, size: str) -> str:
    """A length with its unit, where that is known."""
    return f"{size} {job.length_unit}" if job.length_unit else size


def agreement_sentence(job: FitJob, part: FittedPart, name: str) -> str:
    """How well the part lies on its CAD, and how many cells of the map are out."""
    bad, cells = part.deviations.outside, part.deviations.cells
    where = f"its points scatter about the CAD by {with_unit(job, f'{part.fit.scale:.3f}')} (1 σ)"
    if not bad.any():
        limit = with_unit(job, f"{part.deviations.tolerance:g}")
        return f"{name} is found; {where}, and all {len(bad)} cells of the map are within {limit}."
    worst = with_unit(job, f"{cells.mean[int(np.argmax(np.abs(cells.mean)))]:+.2f}")
    return f"{name} is found; {where}, but {bad.sum()} of {len(bad)} cells of the map are out, by {worst} at most."


def detail_sentences(job: FitJob, part: FittedPart) -> Iterator[str]:
    """Pose with its sigma, stock, doubt, the worst cell and what did not count."""
    yield _pose_sentence(job, part)
    if part.fit.allowance is not None:
        yield allowance_sentence(part.fit.allowance, job.length_unit)
    if part.start.runner_up > 0.9 * part.start.share:
        yield (
            f"Another pose meets {part.start.runner_up:.0%} of the scan, this one {part.start.share:.0%}: the part is "
            "nearly symmetric, or too little of it was scanned."
        )
    if part.deviations.outside.any():
        cells = part.deviations.cells
        worst = int(np.argmax(np.abs(cells.mean)))
        at = ", ".join(f"{axis} {value:.0f}" for axis, value in zip("xyz", cells.middle[worst], strict=True))
        yield (
            f"Worst cell: {with_unit(job, f'{cells.mean[worst]:+.2f}')} at {with_unit(job, at)} of the part's frame "
            "(plus: outside the CAD)."
        )
    for name, count in part.forbidden.items():
        if count:
            yield f"{count} points in forbidden region {name} did not count."


def _pose_sentence(job: FitJob, part: FittedPart) -> str:
    x, y, z, a, b, c = rows_from_poses(part.fit.T_base_part[None])[0]
    shift, turn = part.fit.sigma[3:].max(), np.degrees(part.fit.sigma[:3]).max()
    place = with_unit(job, f"x {x:.3f}, y {y:.3f}, z {z:.3f}")
    return (
        f"T_base_part: {place}, ± {uncertainty_text(shift)} at most; a {a:.4f}, b {b:.4f}, c {c:.4f}° about z, y', "
        f"x'', ± {uncertainty_text(turn)}° at most (1 σ)."
    )

"""Page and recording of a scan fitted onto its CAD: the deviation map, and the path that follows the part."""

from pathlib import Path

import numpy as np
import rerun as rr
from matplotlib.figure import Figure

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.comparison.run_verdict import ToleranceVerdict
from stitch.plugins.cells.scan_to_cad import Deviations, allowance_sentence
from stitch.plugins.cells.window import FitJob, FittedPart, agreement_sentence, with_unit
from stitch.session.scan import even_indices
from viz.cells import stage
from viz.cells.page import Page, Picture, Table, write
from viz.colours import BLUE, ORANGE, SIGNED, signed_colours
from viz.figures import colormap, subplots
from viz.page_parts import Row

# Pictures of a scan on its CAD: the deviation map, and how all distances are spread.

# An STL has no unit.
NO_UNIT = "unit of the CAD"
_MAP_POINTS = 40_000
# Inches that nine leave for the axes beside their labels and the colour bar.
_WIDE = 7.2


def deviation_map(found: Deviations, unit: str) -> Figure:
    """Points along the thinnest axis, coloured by their distance; cells beyond the tolerance ringed.

    Args:
        unit: of all lengths, `NO_UNIT` where only the CAD's file could name it.
    """
    extent = np.ptp(found.points, axis=0)
    i, j = np.sort(np.argsort(extent)[1:])
    figure, ax = subplots(9, min(_WIDE * extent[j] / extent[i] + 0.8, 9))
    pick = even_indices(len(found.points), _MAP_POINTS)
    order = pick[np.argsort(np.abs(found.distance[pick]))]
    colours = {"c": found.distance[order], "cmap": colormap(SIGNED), "vmin": -found.tolerance, "vmax": found.tolerance}
    drawn = ax.scatter(found.points[order, i], found.points[order, j], s=5, lw=0, **colours)
    bad = found.middle[found.outside]
    if len(bad):
        ringed = f"ringed: beyond the tolerance of ±{found.tolerance:g} {unit}"
        ax.plot(bad[:, i], bad[:, j], "o", mfc="none", mec="k", mew=0.6, ms=5, label=ringed)
        ax.legend(fontsize="small", loc="lower right")
    figure.colorbar(drawn, label=f"off the CAD, + outside ({unit})", extend="both", shrink=0.8)
    # White means no deviation, so the ground cannot be white.
    ax.set_facecolor("0.78")
    ax.set(aspect="equal", xlabel=f"{'xyz'[i]} of the part ({unit})", ylabel=f"{'xyz'[j]} of the part ({unit})")
    return figure


def histogram(part: FittedPart, unit: str) -> Figure:
    """Distances of all points, with the tolerance."""
    found = part.deviations
    figure, ax = subplots(7, 2.4)
    reach = max(2 * found.tolerance, 1.05 * float(np.quantile(np.abs(found.distance), 0.999)))
    ax.hist(np.clip(found.distance, -reach, reach), bins=120, color=BLUE, log=True)
    for side in (-1, 1):
        ax.axvline(side * found.tolerance, color=ORANGE, ls="--", lw=1)
    ax.set(xlabel=f"distance from the CAD ({unit}; dashed: tolerance)", ylabel="points", xlim=(-reach, reach))
    return figure


_RECORDED_POINTS, _WORST = 400_000, 10


def write_page(job: FitJob, parts: list[FittedPart], path: Path) -> None:
    """Sentence, a map and a histogram for each part, poses and the worst cells."""
    pictures, unit = [], job.length_unit or NO_UNIT
    named = "" if job.length_unit else " Lengths in the unit of the CAD, whose file names none."
    for i, part in enumerate(parts):
        of = f" of part {i + 1}" if len(parts) > 1 else ""
        cad = "the CAD" if part.fit.allowance is None else "the CAD with its allowance"
        caption = (
            "The scan on the CAD, seen along the part's thinnest axis, outer and inner side alike. Red stands outside "
            f"{cad}, blue inside; full colour is the tolerance of {with_unit(job, f'{job.tolerance:g}')}. Black rings: "
            f"cells of the map whose mean is beyond it.{named}"
        )
        pictures.append(Picture(f"Deviation map{of}", deviation_map(part.deviations, unit), caption, pixels=True))
        caption = "All points with a place on the CAD. What lies far out is a deformed place, and did not pull the fit."
        pictures.append(Picture(f"Distances{of}", histogram(part, unit), caption))
    words = (sentence(job, parts), job.file, _about(job))
    write(Page("Scan onto CAD", *words, pictures, _tables(job, parts), light=_light(job, parts)), path)


def _light(job: FitJob, parts: list[FittedPart]) -> ToleranceVerdict:
    bad, cells = (sum(int(x) for x in own) for own in zip(*map(_counts, parts), strict=True))
    if not bad:
        return ToleranceVerdict("good", f"Within {with_unit(job, f'{job.tolerance:g}')}: all {cells} cells of the map.")
    allowed = with_unit(job, f"{job.tolerance:g}")
    return ToleranceVerdict("bad", f"Not within {allowed}: {bad} of {cells} cells of the map are beyond it.")


def _counts(part: FittedPart) -> tuple[int, int]:
    return int(part.deviations.outside.sum()), len(part.deviations.outside)


def _about(job: FitJob) -> list[Row]:
    return [
        ("Measured", f"{len(job.placed.names)} scans, {len(job.scan.points):,} points"),
        ("Arm", "not stated"),
        ("Scanner", f"noise {with_unit(job, f'{job.scan.noise:.2g}')} as the scans show it"),
        ("CAD", f"{job.cad_file.name}, {with_unit(job, f'{job.cad.size:.4g}')} across"),
        ("Parts in the scan", str(job.instances)),
    ]


def sentence(job: FitJob, parts: list[FittedPart]) -> str:
    """Return how well every part fits, in sentences."""
    sentences = []
    for i, part in enumerate(parts):
        sentences.append(agreement_sentence(job, part, f"Part {i + 1}" if len(parts) > 1 else "The part"))
        if part.fit.allowance is not None:
            sentences.append(allowance_sentence(part.fit.allowance, job.length_unit))
    return " ".join(sentences)


def _tables(job: FitJob, parts: list[FittedPart]) -> list[Table]:
    poses = []
    for i, part in enumerate(parts):
        sigma = part.fit.sigma
        place = (f"{x:.3f}" for x in part.fit.T_base_part[:3, 3])
        sizes = f"{sigma[3:].max():.4f}", f"{np.degrees(sigma[:3]).max():.5f}", f"{part.fit.rms:.3f}"
        shares = f"{part.start_share:.0%}", f"{part.start_runner_up:.0%}"
        poses.append((str(i + 1), *place, *sizes, *shares))
    in_unit = f" ({job.length_unit})" if job.length_unit else ""
    x, y, z = (f"{axis}{in_unit}" for axis in "xyz")
    header = ("part", x, y, z, f"σ{in_unit}", "σ (°)", f"rms{in_unit}", "meets the CAD", "next best pose")
    tables = [
        Table("Where the parts lie in the robot's base, and how much of the scan meets the CAD there", header, poses)
    ]
    tables += _allowances(parts)
    for i, part in enumerate(parts):
        worst = np.argsort(-np.abs(part.deviations.mean))[:_WORST]
        rows = [_cell_row(part.deviations, k) for k in worst]
        title = "Worst cells of the map" + (f" of part {i + 1}" if len(parts) > 1 else "") + ", in the part's frame"
        tables.append(Table(title, (x, y, z, f"deviation{in_unit}", "points", "verdict"), rows))
    return tables


def _allowances(parts: list[FittedPart]) -> list[Table]:
    """Stock on the parts; no table where nobody spoke of it."""
    rows = []
    for i, part in enumerate(parts):
        if (found := part.fit.allowance) is not None:
            kind = "varying" if found.prior.varying else "even" if found.prior.free else "stated"
            sizes = (f"{size:+.4f}" for size in (found.value, found.lowest, found.highest))
            rows.append((str(i + 1), kind, *sizes, f"{found.sigma:.4f}", f"{found.told_apart:.0%}"))
    header = ("part", "allowance", "mean", "lowest", "highest", "σ of the mean", "told from a motion")
    return [Table("Allowance: stock outside the CAD is plus", header, rows)] if rows else []


def _cell_row(found: Deviations, k: int) -> tuple[str, ...]:
    verdict = "bad" if found.outside[k] else "good"
    return *(f"{x:.0f}" for x in found.middle[k]), f"{found.mean[k]:+.3f}", str(found.count[k]), verdict


def record(job: FitJob, parts: list[FittedPart], path: Path) -> None:
    """Base frame: CAD where it was found, points by deviation, scanners, programmed and corrected path."""
    size = job.cad.size
    words = f"# Scan onto CAD\n\n{sentence(job, parts)}\n\n{_LEGEND}"
    with stage.stage(path, "Scan onto CAD", words) as recording:
        for name, T in zip(job.placed.names, job.placed.T_base_scanner, strict=True):
            stage.frame(recording, f"scanners/{name}", T, size / 40)
        for i, part in enumerate(parts):
            T, found = part.fit.T_base_part, part.deviations
            _record_cad(recording, f"part {i + 1}/cad", job, T)
            stage.frame(recording, f"part {i + 1}/frame", T, size / 10)
            pick = even_indices(len(found.points), _RECORDED_POINTS)
            places, colours = (
                frames.transform(T, found.points[pick]),
                signed_colours(found.distance[pick], found.tolerance),
            )
            stage.points(recording, f"part {i + 1}/deviation", places, colours, size / 1200)
            bad = frames.transform(T, found.middle[found.outside])
            stage.points(recording, f"part {i + 1}/out of tolerance", bad, [(20, 20, 20)], size / 300)
            if part.path is not None and job.path is not None:
                stage.line(recording, "path/programmed", job.path[1][:, :3, 3], stage.GREY, size / 500)
                stage.line(recording, f"path/for part {i + 1}", part.path[:, :3, 3], stage.GREEN, size / 400)
                for name, T_tool in zip(job.path[0], part.path, strict=True):
                    stage.frame(recording, f"path/for part {i + 1}/{name}", T_tool, size / 25)


_LEGEND = (
    "Grey: the CAD. Points: red outside, blue inside it, full colour at the tolerance; black: cells beyond it. Grey "
    "line: the path as programmed; green: moved with the part."
)


def _record_cad(recording: stage.Recording, name: str, job: FitJob, T: Array) -> None:
    mesh = job.cad.mesh
    places = np.float32(frames.transform(T, np.asarray(mesh.vertices)))
    shown = rr.Mesh3D(vertex_positions=places, triangle_indices=mesh.faces, albedo_factor=[190, 190, 195, 120])
    recording.log(stage.place(name), shown, static=True)

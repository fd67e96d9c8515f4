"""Page and recording of a seam: cuts at the stations, flush and gap against their limits, verdicts."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.comparison.run_verdict import ToleranceVerdict
from stitch.plugins.cells.seam import VERDICTS, Limits, Seam, Station
from stitch.plugins.cells.window import SeamJob, limits_text, stations_sentence
from stitch.session.scan import even_indices
from viz.cells import stage
from viz.cells.page import Page, Picture, Table, write
from viz.colours import BLUE, DARK, GREEN, ORANGE, YELLOW
from viz.figures import subplots
from viz.page_parts import Row

_COLOURS = dict(zip(VERDICTS, (GREEN, ORANGE, YELLOW, DARK), strict=True))
# Half width of a cut along the seam and half its extent across and down, mm.
_SLICE, _ACROSS, _DOWN = 4.0, 32.0, 14.0
_RECORDED_POINTS = 300_000


def write_page(job: SeamJob, seams: list[Seam], path: Path) -> None:
    """Sentence, values against limits, the seam as a loop, cuts at all stations, table."""
    cut = (
        f"Scanned points within {_SLICE:g} mm of each station, the inner part (window) blue, the outer one (body) "
        "grey, across and outwards at the same scale; dots are the edges between which gap and flush are measured."
    )
    where = "Seen along the mean outward direction; the lines run across the seam."
    pictures = [
        Picture("Flush and gap", values(job.limits, seams), "Bars: two sigmas; grey band: what is allowed."),
        Picture("Cuts across the seam", cuts(job, seams), cut, pixels=True),
        Picture("Where the stations lie", loop(job, seams), where),
    ]
    rows = [
        (s.station, f"{s.flush:+.3f} ± {s.sigma_flush:.3f}", f"{s.gap:.3f} ± {s.sigma_gap:.3f}", s.verdict, s.reason)
        for s in seams
    ]
    tables = [Table("Stations", ("station", "flush (mm)", "gap (mm)", "verdict", "reason"), rows)]
    words = (stations_sentence(job.limits, seams), job.file, _about(job))
    write(Page("Seam", *words, pictures, tables, light=_light(seams)), path)


def _light(seams: list[Seam]) -> ToleranceVerdict:
    """Red where a station is bad, amber where one is open or was not measured."""
    good, bad = (sum(s.verdict == verdict for s in seams) for verdict in ("good", "bad"))
    told = f"{good} of {len(seams)} stations are within the limits with their two sigmas"
    if bad:
        return ToleranceVerdict("bad", f"Not within the limits: {bad} of {len(seams)} stations are beyond them.")
    if good < len(seams):
        return ToleranceVerdict("check", f"Nothing is beyond the limits, but only {told}.")
    return ToleranceVerdict("good", f"Within the limits: {told}.")


def _about(job: SeamJob) -> list[Row]:
    return [
        ("Measured", f"{len(job.stations)} stations, {len(job.placed.names)} scans, {len(job.scan.points):,} points"),
        ("Arm", "not stated"),
        ("Scanner", f"noise {job.scan.noise:.2g} mm as the scans show it"),
        ("Limits", limits_text(job.limits)),
    ]


def values(limits: Limits, seams: list[Seam]) -> Figure:
    """Flush and gap of every station with two sigmas and their bands."""
    figure, axes = subplots(10, 3.0, 1, 2)
    quantities = (("flush", limits.flush, limits.flush_tolerance), ("gap", limits.gap, limits.gap_tolerance))
    for ax, (name, middle, tolerance) in zip(axes, quantities, strict=True):
        ax.axhspan(middle - tolerance, middle + tolerance, color="0.92")
        ax.axhline(middle, color="0.6", lw=0.8)
        for k, s in enumerate(seams):
            value, sigma = getattr(s, name), getattr(s, f"sigma_{name}")
            ax.errorbar(k, value, 2 * sigma, fmt="o", color=_COLOURS[s.verdict], capsize=4)
        ax.set_xticks(range(len(seams)), [s.station for s in seams])
        ax.set(xlabel="station", ylabel=f"{name} (mm)")
    return figure


def cuts(job: SeamJob, seams: list[Seam]) -> Figure:
    """Small pictures of the scanned points at each station, across and outwards."""
    columns = min(4, len(seams))
    rows = -(-len(seams) // columns)
    figure, grid = subplots(10.5, 0.5 + 1.25 * rows, rows, columns, sharex=True, sharey=True, squeeze=False)
    axes = grid.ravel()
    for ax, station, seam in zip(axes, job.stations, seams, strict=False):
        _draw_cut(ax, job, station, seam)
    for ax in axes[len(seams) :]:
        ax.axis("off")
    for ax in axes[-columns:]:
        ax.set_xlabel("across (mm)")
    for ax in axes[::columns]:
        ax.set_ylabel("out (mm)")
    return figure


def _draw_cut(ax: Axes, job: SeamJob, station: Station, seam: Seam) -> None:
    T = frames.inverse(job.T_base_part @ station.T_part_station)
    local = frames.transform(T, job.scan.points)
    near = (np.abs(local) < [_ACROSS, _SLICE, _DOWN]).all(axis=1)
    a, _, h = local[near].T
    ax.scatter(a, h, s=2, c=np.where(a < 0, BLUE, DARK), lw=0)
    colour = _COLOURS[seam.verdict]
    for edge in (seam.inner, seam.outer):
        if edge is not None:
            ax.plot(*edge, "o", color=colour, ms=5, mec="white")
    text = seam.verdict if seam.reason else f"flush {seam.flush:+.2f}, gap {seam.gap:.2f} mm"
    ax.set_title(f"{seam.station}: {text}", fontsize=9, color=colour)
    ax.set(xlim=(-_ACROSS, _ACROSS), ylim=(-_DOWN, 6), aspect="equal")


def loop(job: SeamJob, seams: list[Seam]) -> Figure:
    """The stations in their plane."""
    middle = np.array([station.middle for station in job.stations])
    out = np.mean([station.outwards for station in job.stations], axis=0)
    axes_of_plane = _plane(out)
    flat = (middle - middle.mean(axis=0)) @ axes_of_plane.T
    figure, ax = subplots(7, 3.6)
    reach = 0.05 * float(np.ptp(flat, axis=0).max())
    ax.plot(*np.vstack([flat, flat[:1]]).T, color="0.8", lw=1, ls=":")
    for at, station, seam in zip(flat, job.stations, seams, strict=True):
        towards = axes_of_plane @ station.across * reach
        ax.plot(*np.array([at - towards, at + towards]).T, color=_COLOURS[seam.verdict], lw=3, solid_capstyle="round")
        ax.annotate(seam.station, at + 1.9 * towards, ha="center", va="center", fontsize=11)
    for verdict in dict.fromkeys(s.verdict for s in seams):
        ax.plot([], [], color=_COLOURS[verdict], lw=3, label=verdict)
    ax.set(aspect="equal", xlabel="in the plane of the stations (mm)", ylabel="upwards in it (mm)")
    ax.margins(0.15)
    ax.legend(frameon=False, loc="center")
    return figure


def _plane(out: Array) -> Array:
    """(2, 3) axes of the plane across `out`: the second as near z as it can be."""
    n = out / np.linalg.norm(out)
    up = np.array([0.0, 0.0, 1.0]) if abs(n[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    up = up - (up @ n) * n
    up /= np.linalg.norm(up)
    return np.array([np.cross(up, n), up])


def record(job: SeamJob, seams: list[Seam], path: Path) -> None:
    """Base frame: scanned points, station frames, the gap as a line between its edges, verdicts as labels."""
    points = job.scan.points
    pick = even_indices(len(points), _RECORDED_POINTS)
    words = f"# Seam\n\n{stations_sentence(job.limits, seams)}\n\nThe lines across the seam run from edge to edge."
    with stage.stage(path, "Seam", words) as recording:
        stage.points(recording, "scan", points[pick], [stage.GREY], 0.35)
        for station, seam in zip(job.stations, seams, strict=True):
            T, colour = job.T_base_part @ station.T_part_station, _rgb(_COLOURS[seam.verdict])
            stage.frame(recording, f"stations/{seam.station}", T, 12.0)
            if seam.inner is not None and seam.outer is not None:
                edges = np.array([[edge[0], 0.0, edge[1]] for edge in (seam.inner, seam.outer)])
                edges = frames.transform(T, edges)
                stage.line(recording, f"stations/{seam.station}/gap", edges, colour, 0.8)
                label = [f"{seam.verdict}: flush {seam.flush:+.2f}, gap {seam.gap:.2f} mm"]
                stage.points(recording, f"stations/{seam.station}/verdict", edges[1:], [colour], 1.5, label)


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)

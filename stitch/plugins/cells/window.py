"""`stitch fit` and `stitch seam`: both window jobs from their readings to their results and files.

`stitch fit JOB --follow` says where a part stands that moves, from scan to scan. A line on standard input names a
table of scans, as `scans` in the job; a line of JSON answers it: T_base_part with its sigma, the path moved with the
part, and how long the answer took. Each fit begins at the pose before, so that nothing is sought anew; the pose holds
for the time at which the scans were taken.
"""

import json
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.cli.terminal import say, show_table
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import uncertainty_text
from stitch.output.session_files import SessionFiles, pose_columns
from stitch.plugins.cells.cad import Box, CadSurface, Regions, coverage, read_cad
from stitch.plugins.cells.job_files import (
    POSE_COLUMNS,
    JobTable,
    Wanted,
    checked_table,
    hand_out,
    poses_from_columns,
    read_columns,
    read_job_file,
    require_unique,
    rows_from_poses,
    write_columns,
    write_poses,
)
from stitch.plugins.cells.placed_scans import (
    SOURCES,
    JoinedScans,
    PlacedScans,
    assemble_scans,
    exact_placing,
    read_placed_session,
    read_scan_table,
    stated_errors,
    with_part_yet_to_place,
)
from stitch.plugins.cells.scan_to_cad import (
    AllowancePrior,
    CadFit,
    Deviations,
    allowance_sentence,
    find_cad_start,
    fit_cad,
    measure_deviations,
    read_allowance,
    split_instances,
    write_deviation_csv,
    write_deviation_ply,
)
from stitch.plugins.cells.seam import VERDICTS, Limits, Pane, Seam, Station, measure_seam
from stitch.session.session import Cloud

FIT_FORMAT = "stitch-fit/1"
SEAM_FORMAT = "stitch-seam/1"
_SCANS = {"scans", "session", "hand_eye", "errors"}
_FIT_KEYS = {"format", *_SCANS, "cad", "length_unit", "instances", "tolerance", "cell", "region", "nominal", "path"}
_FIT_KEYS |= {"coverage"}
_SEAM_KEYS = {"format", *_SCANS, "stations", "fit", "part", "limits", "pose_sigma", "pane"}
NO_UNIT = "Lengths in the unit of the CAD, whose file names none; length_unit in the job states it."
_SOURCE_WORDS = {"scan": "the scan's noise"} | {source: f"the {source.replace('_', '-')}" for source in SOURCES}
# Points that scatter about the CAD so many times as much as when the part was found do not lie on it.
_LOST = 3.0


@dataclass(frozen=True)
class FitJob:
    """Scans onto one CAD model; lengths in the CAD's unit, `length_unit` where somebody says which that is."""

    placed: PlacedScans
    scan: JoinedScans  # the same as one cloud
    cad: CadSurface
    cad_file: Path
    instances: int
    tolerance: float
    cell: float
    regions: Regions
    coverage: float  # share of every expected region that must be seen
    T_base_part_nominal: Array | None  # (4, 4)
    path: tuple[list[str], Array] | None  # names and T_base_tool (N, 4, 4)
    file: Path | None = None  # that was read
    allowance_prior: AllowancePrior = field(default_factory=AllowancePrior)  # of the stock on the part
    length_unit: str | None = None


@dataclass(frozen=True)
class SeamJob:
    """Scans of a seam, where the part lies and where to measure; mm."""

    placed: PlacedScans
    scan: JoinedScans  # the same as one cloud
    T_base_part: Array  # (4, 4)
    stations: tuple[Station, ...]
    limits: Limits
    file: Path | None = None  # that was read
    pane: Pane | None = None  # where it is yet to be placed


def read_fit_job(file: Path | str) -> FitJob:
    """Read and check a job of `stitch fit`.

    Raises:
        InputError: a file is missing or malformed; an entry is missing, unknown or impossible.
    """
    file = Path(file)
    document = read_job_file(file, FIT_FORMAT, _FIT_KEYS, "examples/window/fit.toml")
    nominal = document.pose("nominal") if "nominal" in document else None
    path = None
    if "path" in document:
        if nominal is None:
            raise InputError(
                f"{file}: path has no [nominal]; to fix: give the part's pose for which the path was programmed"
            )
        rows = read_columns(document.path("path"), "name", POSE_COLUMNS)
        path = (rows.texts["name"], poses_from_columns(rows))
    instances = document.entries.get("instances", 1)
    if not isinstance(instances, int) or isinstance(instances, bool) or instances < 1:
        raise document.refusal("instances", "write how many parts are in the scan, 1 or more")
    cad_file = document.path("cad")
    cad = read_cad(cad_file)
    placed = _read_scans(document)
    unit = placed.length_unit if "session" in document else None  # else neither scans nor CAD name it
    if "length_unit" in document:
        unit = document.choice("length_unit", (unit,) if unit else ("mm", "m"))
    return FitJob(
        placed=placed,
        scan=assemble_scans(placed),
        cad=cad,
        cad_file=cad_file,
        instances=instances,
        tolerance=document.number("tolerance", 0.5, positive=True),
        cell=document.number("cell", cad.size / 60, positive=True),
        regions=_read_regions(document),
        coverage=document.number("coverage", 0.5),
        T_base_part_nominal=nominal,
        path=path,
        file=file,
        length_unit=unit,
    )


def read_seam_job(file: Path | str) -> SeamJob:
    """Read and check a job of `stitch seam`.

    Raises:
        InputError: a file is missing or malformed; an entry is missing, unknown or impossible.
    """
    file = Path(file)
    document = read_job_file(file, SEAM_FORMAT, _SEAM_KEYS, "examples/window/seam.toml")
    if ("part" in document) == ("fit" in document):
        raise InputError(f"{file}: no place of the part; to fix: give [part] with its pose, or fit = its fit.json")
    T_base_part = document.pose("part") if "part" in document else _fitted_pose(document.path("fit"))
    limits = document.table("limits", Limits.__dataclass_fields__)
    placed = _read_scans(document)
    if pose_sigma := abs(document.number("pose_sigma", 0.0)):
        # Two scans stand that far off each other where each stands a √2th of it off its place.
        errors = placed.errors or exact_placing(placed)
        placed = replace(placed, errors=replace(errors, rotation=0.0, translation=pose_sigma / np.sqrt(2)))
    pane = None
    if "pane" in document:
        entries = document.table("pane", ("session", "fit", "thickness"), required=True)
        pane = Pane(len(placed.names), entries.number("thickness", positive=True))
        # Both CADs lie in one frame, as the window sits in the body.
        T = T_base_part @ frames.inverse(_fitted_pose(entries.path("fit")))
        loose = read_placed_session(entries.path("session"), document.path("hand_eye"))
        placed = with_part_yet_to_place(placed, replace(loose, errors=stated_errors(document, loose)), T)
    return SeamJob(
        placed=placed,
        scan=assemble_scans(placed),
        T_base_part=T_base_part,
        stations=_read_stations(document.path("stations")),
        limits=Limits(**{key: limits.number(key, positive="tolerance" in key) for key in limits.entries}),
        file=file,
        pane=pane,
    )


def _read_scans(document: JobTable) -> PlacedScans:
    """Read scans from a table of scanner poses, or from a session and a hand-eye."""
    file = document.file
    if ("scans" in document) == ("session" in document):
        raise InputError(f"{file}: no scans; to fix: give scans = a table of them, or session = a session folder")
    if "scans" in document and "hand_eye" in document:
        raise InputError(
            f"{file}: hand_eye goes with session; to fix: leave it out, for a table of scans has the scanner's poses"
        )
    if "scans" in document:
        placed = read_scan_table(document.path("scans"))
    elif "hand_eye" in document:
        placed = read_placed_session(document.path("session"), document.path("hand_eye"))
    else:
        raise InputError(
            f"{file}: session has no hand_eye; to fix: name the file that `stitch calibrate sphere -o` wrote"
        )
    return replace(placed, errors=stated_errors(document, placed))


def _read_regions(document: JobTable) -> Regions:
    boxes: dict[str, list[Box]] = {"expected": [], "forbidden": []}
    entries = document.entries.get("region", [])
    if not isinstance(entries, list):
        raise InputError(f"{document.file}: region is no list; to fix: write [[region]], one for each box")
    for i, entry in enumerate(entries):
        region = checked_table(document.file, f"region[{i + 1}]", entry, {"name", "kind", "low", "high"})
        kind = region.choice("kind", boxes)
        low, high = (region.vectors(key, (3,), "[x, y, z] in the part's frame") for key in ("low", "high"))
        if (low >= high).any():
            raise InputError(
                f"{document.file}: the box {region.place} is empty; to fix: write low below high in x, y and z"
            )
        boxes[kind].append(Box(str(entry.get("name", region.place)), low, high))
    return Regions(tuple(boxes["expected"]), tuple(boxes["forbidden"]))


def _fitted_pose(file: Path) -> Array:
    """Read T_base_part (4, 4) of the first part of a fit.json."""
    try:
        T = np.array(json.loads(file.read_text(encoding="utf-8"))["parts"][0]["T_base_part"], float)
    except FileNotFoundError:
        raise InputError(f"{file}: not found; to fix: run stitch fit with -o first, or give [part]") from None
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(
            f"{file}: holds no parts[0].T_base_part; to fix: name the fit.json that stitch fit wrote"
        ) from None
    if not frames.is_rigid(T):
        raise InputError(f"{file}: parts[0].T_base_part is no rigid motion; to fix: run stitch fit again")
    return T


def _read_stations(file: Path) -> tuple[Station, ...]:
    columns = read_columns(file, "station", "x y z across_x across_y across_z out_x out_y out_z")
    names = columns.texts["station"]
    across = columns.stack("across_x across_y across_z")
    out = columns.stack("out_x out_y out_z")
    require_unique(file, "station", names)
    for i, name in enumerate(names):
        if np.linalg.norm(np.cross(across[i], out[i])) < 0.5 or abs(np.linalg.norm(out[i]) - 1) > 0.05:
            raise InputError(
                f"{file}: station {name}: across and out are not unit vectors at right angles; to fix: correct them"
            )
    return tuple(map(Station, names, columns.stack("x y z"), across, out))


@dataclass(frozen=True)
class FittedPart:
    """One part found in the scan."""

    fit: CadFit
    start_share: float  # of the scan that met the CAD before the fit
    start_runner_up: float  # the same of the best pose elsewhere
    deviations: Deviations
    coverage: dict[str, float]  # of expected regions
    forbidden: dict[str, int]  # usable points in forbidden regions
    path: Array | None  # (N, 4, 4) corrected T_base_tool


def fit_part(job: FitJob, scan: JoinedScans) -> FittedPart:
    """Find, fit and map one part in its own scan.

    Raises:
        NoResultError: the part is not found, or an expected region is not covered.
    """
    T_start, share_there, runner_up = find_cad_start(scan, job.cad)
    fit = fit_cad(scan, job.cad, T_start, job.regions, job.allowance_prior, job.placed.errors)
    T = frames.inverse(fit.T_base_part)
    local = frames.transform(T, scan.points[scan.usable])
    normals = frames.rotate(T, scan.normals[scan.usable])
    covered = {box.name: coverage(box, job.cad, local, normals) for box in job.regions.expected}
    for name, share in covered.items():
        if share < job.coverage:
            raise NoResultError(
                f"expected region {name}: only {share:.0%} of it was scanned, {job.coverage:.0%} wanted; to fix: "
                "scan it, or lower `coverage`"
            )
    forbidden = {box.name: int(box.holds(local).sum()) for box in job.regions.forbidden}
    path = None
    if job.path is not None and job.T_base_part_nominal is not None:
        path = correct_path(job.path[1], job.T_base_part_nominal, fit.T_base_part)
    deviations = measure_deviations(scan, job.cad, fit.T_base_part, job.tolerance, job.cell, fit.allowance)
    return FittedPart(fit, share_there, runner_up, deviations, coverage=covered, forbidden=forbidden, path=path)


def correct_path(T_base_tool: Array, T_base_part_nominal: Array, T_base_part: Array) -> Array:
    """Return poses (N, 4, 4) that stand to the found part as the programmed ones stand to the nominal part.

    T_base_tool' = T_base_part · T_base_part_nominal⁻¹ · T_base_tool.
    """
    return T_base_part @ frames.inverse(T_base_part_nominal) @ T_base_tool


def fit_document(job: FitJob, parts: list[FittedPart]) -> dict[str, Any]:
    """Return plain data for JSON; length_unit of the CAD, degrees."""
    nominal = job.T_base_part_nominal
    return {
        "format": "stitch-fit-result/1",
        "length_unit": job.length_unit,
        "noise": job.scan.noise,
        "T_base_part_nominal": None if nominal is None else nominal.tolist(),
        "parts": [_part_document(p) for p in parts],
    }


def _part_document(part: FittedPart) -> dict[str, Any]:
    cells = part.deviations
    worst = None
    if len(cells.mean):
        worst = {"at": cells.middle[cells.worst].tolist(), "deviation": float(cells.mean[cells.worst])}
    pose = rows_from_poses(part.fit.T_base_part[None])[0].tolist()
    document = {
        "T_base_part": part.fit.T_base_part.tolist(),
        "pose": dict(zip(POSE_COLUMNS.split(), pose, strict=True)),
        "sigma": part.fit.sigma[3:].tolist(),
        "sigma_deg": np.degrees(part.fit.sigma[:3]).tolist(),
        "sigma_parts": {name: np.sqrt(np.diag(C)[3:]).tolist() for name, C in part.fit.parts.items()},
        **{key: getattr(part.fit, key) for key in ("scale", "rms", "inliers", "points")},
        **{key: getattr(part, key) for key in ("start_share", "start_runner_up")},
        "cells": len(cells.mean),
        "cells_outside": int(cells.outside.sum()),
        "worst": worst,
        "coverage": part.coverage,
        "points_in_forbidden": part.forbidden,
    }
    if (allowance := part.fit.allowance) is not None:
        kind = "varying" if allowance.prior.varying else "free" if allowance.prior.free else "stated"
        numbers = ("value", "sigma", "lowest", "highest", "sigma_field", "told_apart")
        document["allowance"] = {"kind": kind} | {key: getattr(allowance, key) for key in numbers}
    return document


def write_fit(job: FitJob, parts: list[FittedPart], folder: Path) -> list[str]:
    """Write fit.json, and for each part its map and path; returns the files' names."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "fit.json").write_text(json.dumps(fit_document(job, parts), indent=1) + "\n", encoding="utf-8")
    written = ["fit.json"]
    for i, part in enumerate(parts):
        tail = f"-{i + 1}" if len(parts) > 1 else ""
        names = [f"deviation{tail}.ply", f"deviation{tail}.csv"]
        write_deviation_ply(folder / names[0], part.deviations)
        write_deviation_csv(folder / names[1], part.deviations)
        if part.path is not None and job.path is not None:
            names.append(f"path{tail}.csv")
            write_poses(folder / names[-1], "name", job.path[0], part.path)
        written += names
    return written


def solve_seam(job: SeamJob) -> list[Seam]:
    """Return flush and gap at every station.

    Raises:
        NoResultError: no station could be measured.
    """
    seams = measure_seam(job.scan, job.T_base_part, job.stations, job.limits, job.placed.errors, job.pane)
    if all(seam.verdict == "not measured" for seam in seams):
        raise NoResultError(f"no station could be measured; the first: {seams[0].reason}")
    return seams


def write_seam(seams: list[Seam], file: Path) -> None:
    """Write one row per station."""
    names = ["station", "flush", "gap", "sigma_flush", "sigma_gap", "verdict", "reason"]
    if any(np.isfinite(seam.bond) for seam in seams):
        names += ["bond", "sigma_bond"]
    write_columns(file, {name: [getattr(seam, name) for seam in seams] for name in names})


def seam_document(seams: list[Seam]) -> list[dict[str, Any]]:
    """Return plain data for JSON, null where a station could not be measured; mm."""
    return [{k: None if isinstance(v, float) and np.isnan(v) else v for k, v in asdict(s).items()} for s in seams]


def with_unit(job: FitJob, size: str) -> str:
    """Return a length with its unit, where that is known."""
    return f"{size} {job.length_unit}" if job.length_unit else size


def agreement_sentence(job: FitJob, part: FittedPart, name: str) -> str:
    """Say how well the part lies on its CAD, and how many cells of the map are out."""
    cells = part.deviations
    bad = cells.outside
    where = f"its points scatter about the CAD by {with_unit(job, f'{part.fit.scale:.3f}')} (1 σ)"
    if not bad.any():
        limit = with_unit(job, f"{cells.tolerance:g}")
        return f"{name} is found; {where}, and all {len(bad)} cells of the map are within {limit}."
    worst = with_unit(job, f"{cells.mean[cells.worst]:+.2f}")
    return f"{name} is found; {where}, but {bad.sum()} of {len(bad)} cells of the map are out, by {worst} at most."


def detail_sentences(job: FitJob, part: FittedPart) -> Iterator[str]:
    """Say the pose with its sigma, stock, a second pose that fits too, the worst cell and what did not count."""
    x, y, z, a, b, c = rows_from_poses(part.fit.T_base_part[None])[0]
    shift = part.fit.sigma[3:].max()
    turn = np.degrees(part.fit.sigma[:3]).max()
    place = with_unit(job, f"x {x:.3f}, y {y:.3f}, z {z:.3f}")
    yield (
        f"T_base_part: {place}, ± {uncertainty_text(shift)} at most; a {a:.4f}, b {b:.4f}, c {c:.4f}° about z, y', "
        f"x'', ± {uncertainty_text(turn)}° at most (1 σ)."
    )
    yield _sigma_sentence(job, part)
    if part.fit.allowance is not None:
        yield allowance_sentence(part.fit.allowance, job.length_unit)
    if part.start_runner_up > 0.9 * part.start_share:
        yield (
            f"Another pose meets {part.start_runner_up:.0%} of the scan, this one {part.start_share:.0%}: the part is "
            "nearly symmetric, or too little of it was scanned."
        )
    cells = part.deviations
    if cells.outside.any():
        at = ", ".join(f"{axis} {value:.0f}" for axis, value in zip("xyz", cells.middle[cells.worst], strict=True))
        yield (
            f"Worst cell: {with_unit(job, f'{cells.mean[cells.worst]:+.2f}')} at {with_unit(job, at)} of the part's "
            "frame (plus: outside the CAD)."
        )
    for name, count in part.forbidden.items():
        if count:
            yield f"{count} points in forbidden region {name} did not count."


def _sigma_sentence(job: FitJob, part: FittedPart) -> str:
    """Say what the ± of the place counts, largest first."""
    sizes = {name: float(np.sqrt(np.diag(C)[3:].max())) for name, C in part.fit.parts.items()}
    if len(sizes) == 1:
        return "± counts the scan's noise alone; [errors] in the job states those of robot and scanner."
    names = sorted((name for name, size in sizes.items() if size), key=lambda name: -sizes[name])
    sources = (with_unit(job, f"{_SOURCE_WORDS[name]} {uncertainty_text(sizes[name])}") for name in names)
    return f"± of the place by source: {', '.join(sources)}."


def scan_session(name: str, placed: PlacedScans, cad: Path | None = None) -> SessionFiles:
    """Return one view for each scan; where only the scanner's poses were known, the scanner counts as the flange."""
    files = [f"clouds/{view}.ply" for view in placed.names]
    tables = {"scanner": {"pose": placed.T_flange_scanner.tolist()}}
    if cad is not None:
        tables["part"] = {"cad": cad.name, "cad_unit": placed.length_unit}
    return SessionFiles(
        name=name,
        length_unit=placed.length_unit,
        mount="eye_in_hand",
        tables=tables,
        views={"view": placed.names, "cloud": files, **pose_columns(placed.T_base_flange)},
        clouds={file: Cloud(points) for file, points in zip(files, placed.clouds, strict=True)},
        copies=() if cad is None else (cad,),
    )


def run_fit(file: Path, allowance: str | None, wanted: Wanted) -> None:
    """Fit the parts of a job and hand out what was asked for; `InputError` and `NoResultError` end it."""
    prior = read_allowance(allowance)
    job = replace(read_fit_job(file), allowance_prior=prior)
    parts = [fit_part(job, scan) for scan in split_instances(job.scan, job.cad, job.instances)]
    written = write_fit(job, parts, wanted.output) if wanted.output is not None else []
    session = [scan_session(file.stem, job.placed, job.cad_file)]
    if not hand_out("fit", wanted, lambda: session, lambda: fit_document(job, parts), job, parts):
        return
    for i, part in enumerate(parts):
        say(agreement_sentence(job, part, f"Part {i + 1}" if len(parts) > 1 else "The part"))
        for line in detail_sentences(job, part):
            say(f"  {line}")
    if job.length_unit is None:
        say(NO_UNIT)
    for name in written:
        print(f"{wanted.output}/{name}")


def limits_text(limits: Limits) -> str:
    """Say what is allowed."""
    flush = f"flush {limits.flush:g} ± {limits.flush_tolerance:g} mm"
    return f"{flush}, gap {limits.gap:g} ± {limits.gap_tolerance:g} mm"


def stations_sentence(limits: Limits, seams: list[Seam]) -> str:
    """Say how many stations are good."""
    counts = Counter(seam.verdict for seam in seams)
    verdicts = ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict])
    return f"{len(seams)} stations: {verdicts}. Allowed: {limits_text(limits)}."


def run_seam(file: Path, wanted: Wanted) -> None:
    """Measure the stations of a seam and hand out what was asked for; `InputError` and `NoResultError` end it."""
    job = read_seam_job(file)
    seams = solve_seam(job)
    if wanted.output is not None:
        write_seam(seams, wanted.output)
    if not hand_out(
        "seam", wanted, lambda: [scan_session(file.stem, job.placed)], lambda: seam_document(seams), job, seams
    ):
        return
    say(stations_sentence(job.limits, seams))
    rows = [
        (s.station, "", "", *([""] if job.pane else []), f"{s.verdict}: {s.reason}")
        if s.reason
        else (
            s.station,
            f"{s.flush:+.3f} ± {s.sigma_flush:.3f}",
            f"{s.gap:.3f} ± {s.sigma_gap:.3f}",
            *([f"{s.bond:.3f} ± {s.sigma_bond:.3f}"] if job.pane else []),
            s.verdict,
        )
        for s in seams
    ]
    columns = ("station", "flush / mm", "gap / mm", *(["bond gap / mm"] if job.pane else []), "verdict")
    show_table("Stations, ± 1 σ", columns, rows, ("station", "verdict"))
    if wanted.output is not None:
        print(wanted.output)


def follow_part(job: FitJob, found: CadFit, tables: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Yield an answer to each table of scans; `lost` where the part is not there: the next begins at the last pose.

    Args:
        found: the part before it moved, or as it moved when it was found.
        tables: names of files, a line each.

    Raises:
        InputError: a table that is missing or malformed.
    """
    T_base_part = found.T_base_part
    for line in tables:
        begun = time.perf_counter()
        answer: dict[str, Any] = {"scans": line.strip()}
        placed = read_scan_table(Path(line.strip()))
        errors = job.placed.errors
        if errors is not None:
            errors = replace(errors, T_base_flange=placed.T_base_scanner @ frames.inverse(errors.T_flange_scanner))
        try:
            fit = fit_cad(assemble_scans(placed), job.cad, T_base_part, job.regions, job.allowance_prior, errors)
            if fit.scale > _LOST * found.scale:
                raise NoResultError(
                    f"points scatter by {fit.scale:.3g} about the CAD, {found.scale:.3g} when it was found"
                )
        except NoResultError as error:
            yield answer | {"lost": str(error), "latency_s": time.perf_counter() - begun}
            continue
        T_base_part = fit.T_base_part
        answer |= {"T_base_part": T_base_part.tolist()}
        answer |= {"sigma": fit.sigma[3:].tolist(), "sigma_deg": np.degrees(fit.sigma[:3]).tolist()}
        if job.path is not None and job.T_base_part_nominal is not None:
            path = rows_from_poses(correct_path(job.path[1], job.T_base_part_nominal, T_base_part)).tolist()
            poses = (dict(zip(POSE_COLUMNS.split(), row, strict=True)) for row in path)
            answer["path"] = dict(zip(job.path[0], poses, strict=True))
        yield answer | {"latency_s": time.perf_counter() - begun}


def run_follow(file: Path, allowance: str | None, wanted: Wanted) -> None:
    """Find the part of a job, then answer standard input until it ends; `InputError` and `NoResultError` end it."""
    if wanted != Wanted():
        raise InputError("--follow writes answers alone; to fix: leave out the other outputs, or run without --follow")
    job = replace(read_fit_job(file), allowance_prior=read_allowance(allowance))
    (scan,) = split_instances(job.scan, job.cad, 1)
    for answer in follow_part(job, fit_part(job, scan).fit, sys.stdin):
        print(json.dumps(answer), flush=True)

"""Planned views as a linear model: what their scans would say, with the scatter that is expected of them.

How large the errors of planned views would be found is drawn, and fitted as a run fits it: no number of views excludes
that an arm errs by a little more than its scatter; how much they leave open is what the covariance of a run counts. It
is the posterior mean of the variances, averaged over draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from stitch.diagnosis.diagnose import linear_model_of
from stitch.errors import InputError, NoResultError
from stitch.model.model import Model, displacement
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import equilibrated, generalised_fit
from stitch.numerics.reml import NOISE, USUAL_NOISE_FACTOR, at_variances, fit_variances
from stitch.numerics.units import METRES, angle_text, length_text
from stitch.numerics.variance_posterior import mean_variances
from stitch.observations.linear_model import WHITE_COMPONENTS, LinearModel
from stitch.observations.surfaces.hand_eye_fit import weak_prior
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.observations.surfaces.scanner_errors import ALARM_SHARE, USUAL_SHARE
from stitch.observations.surfaces.surface_model import surface_model
from stitch.observations.surfaces.view_poses import SAMPLES, UnconstrainedPoses
from stitch.run_data import RunData
from stitch.session.capture import Capture, build_capture
from stitch.session.measurement import Measurement, measurement_of, with_part_origin
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.text_files import reason_of, require_file
from stitch.session.scan import GRAZING_COSINE, even_indices, prepare_scan
from stitch.session.session import SessionData

if TYPE_CHECKING:
    import trimesh


# Points on the whole surface: a view sees a third of them, and a few thousand say what millions would.
_POINTS = 9_000
# Sides of a block that stands for a part of which only the size is known.
_SIDES = np.array([1.0, 0.7, 0.5])
# A ray is as wide as so many distances between the points; what lies so many rays' widths behind another is hidden.
_RAY = 2.0
_BEHIND = 4.0
# Cosine to the optical axis beyond which no scanner sees.
_AHEAD = 0.3
# Scatter of a good arm's flange, sigma per axis (rad, mm), and an area scanner's noise along the ray (mm): where nobody
# states them. EN ISO 9283 repeatabilities of 0.05 to 0.1 mm are sigmas of 14 to 28 µm.
USUAL_ROTATION = 20e-6
USUAL_TRANSLATION = 0.02
USUAL_NOISE = 0.02
# Points farther apart than so many spacings and sigmas of the noise are not of one place.
_SPACINGS = 1.5
_SIGMAS = 6.0
# Fewer points of a view say nothing of six directions.
FEWEST = 60
# Full angle of the field where nobody states it, and how far it reaches about the standoff.
USUAL_FIELD_DEG = 30.0
_DEPTH = 0.3
# Of what a run's scanner saw, the share that counts as its field, and what is added to it.
_SEEN = 0.99
_MARGIN = 0.1
# Draws among so many numbers at the most; a fit among more takes seconds, and the expected variances must do.
_DRAWS = ((150, 3), (400, 1))


@dataclass(frozen=True)
class PlannedPart:
    """Points (N, 3) on a surface and their outward normals (N, 3); length_unit."""

    points: Array
    normals: Array

    @property
    def centre(self) -> Array:
        """(3,) middle of its box."""
        return (self.points.min(axis=0) + self.points.max(axis=0)) / 2

    @property
    def size(self) -> float:
        """Diagonal of its box."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def moved(self, T: Array) -> PlannedPart:
        """The surface in another frame, T (4, 4)."""
        return PlannedPart(frames.transform(T, self.points), frames.rotate(T, self.normals))


def surface_of_file(file: Path, scale: float) -> PlannedPart:
    """A mesh (STL, PLY, OBJ …), or a cloud with normals, as that of a run; `scale` turns its unit into the session's.

    Raises:
        InputError: missing, unreadable, or a cloud without normals.
    """
    require_file(file, "name a mesh or a cloud of the part")
    mesh = _read_mesh(file)
    if mesh is not None:
        mesh.apply_scale(scale)
        return surface_of_mesh(mesh)
    cloud = read_cloud(file, scale)
    if cloud.normals is None:
        raise InputError(f"{file}: the cloud has no normals; to fix: name a mesh, or stitched.ply of a run")
    return thinned_surface(cloud.points, cloud.normals)


def thinned_surface(points: Array, normals: Array, at_most: int = _POINTS) -> PlannedPart:
    """At most so many points (N, 3) of a cloud with their normals (N, 3), evenly over their order."""
    picked = even_indices(len(points), at_most)
    return PlannedPart(points[picked], normals[picked])


def block_surface(size: float) -> PlannedPart:
    """Return a block of 1 : 0.7 : 0.5 about the origin, for a part of which only the largest side is known."""
    import trimesh

    return surface_of_mesh(trimesh.creation.box(extents=size * _SIDES))


def _read_mesh(file: Path) -> trimesh.Trimesh | None:
    """None where the file holds no triangles."""
    if file.suffix.lower() not in (".stl", ".obj", ".off", ".glb", ".gltf", ".ply"):
        return None
    import trimesh

    try:
        mesh = trimesh.load_mesh(file)
    except Exception as error:  # whatever a library raises at bytes that are no mesh
        raise InputError(f"{file}: cannot be read ({reason_of(error)}); to fix: export it again") from None
    return mesh if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) else None


def surface_of_mesh(mesh: trimesh.Trimesh) -> PlannedPart:
    """Points spread over a mesh at random, the same every time."""
    import trimesh

    points, faces = trimesh.sample.sample_surface(mesh, _POINTS, seed=0)
    return PlannedPart(np.asarray(points), np.asarray(mesh.face_normals[faces]))


@dataclass(frozen=True)
class FieldOfView:
    """Where a scanner sees: slopes x/z and y/z up to `half` (2,), distances from `near` to `far`, along `axis` (3,)."""

    half: Array
    near: float
    far: float
    standoff: float
    axis: Array


def expected_scan(part: PlannedPart, T_reference_scanner: Array, field: FieldOfView) -> Indices:
    """Indices of the part's points that the scanner sees.

    Args:
        part: in the reference frame.
        T_reference_scanner: (4, 4).
    """
    T = frames.inverse(T_reference_scanner)
    points = frames.transform(T, part.points)
    # What lies behind the scanner, or beside it, has no slope.
    ahead = np.flatnonzero(points @ field.axis > _AHEAD * np.linalg.norm(points, axis=1))
    if not len(ahead):
        return ahead
    points = points[ahead]
    normals = frames.rotate(T, part.normals[ahead])
    slopes = points[:, :2] / (points @ field.axis)[:, None]
    reach = np.linalg.norm(points, axis=1)
    cosine = -np.einsum("ij,ij->i", points, normals) / reach
    inside = (np.abs(slopes) <= field.half).all(axis=1) & (reach > field.near) & (reach < field.far)
    return ahead[inside & (cosine > GRAZING_COSINE) & ~_is_occluded(slopes, reach)]


def _is_occluded(slopes: Array, reach: Array) -> Mask:
    """(N,) bool: another point lies in the same ray, well before it."""
    area = max(float(np.prod(np.ptp(slopes, axis=0))), 1e-12)
    ray = _RAY * np.sqrt(area / len(slopes))
    cells = np.floor(slopes / ray).astype(np.int64)
    cells -= cells.min(axis=0)
    number = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    nearest = np.full(number.max() + 1, np.inf)
    np.minimum.at(nearest, number, reach)
    return reach > nearest[number] + _BEHIND * ray * nearest[number]


@dataclass(frozen=True)
class Scatter:
    """Standard deviations that are expected; length_unit, rad."""

    rotation: float  # of the flange, per axis
    translation: float
    noise: float  # of the scanner, along the ray
    noise_factor: float  # variance of what overlaps say over that of white noise
    errors: dict[str, float]  # variances of pose errors that repeat, by component; of none that is not in here
    assumed: tuple[str, ...] = ()  # what nobody stated, in words

    def variances(self, names: Sequence[str]) -> Array:
        """(3 + c,) of rotation, translation, noise, and pose errors of these names."""
        white = (self.rotation**2, self.translation**2, self.noise_factor)
        return np.array([*white, *(max(self.errors.get(name, 0.0), 1e-30) for name in names)])


def stated_scatter(session: SessionData) -> Scatter:
    """Return the scatter that session.toml states, or the usual one; no errors that repeat."""
    unit = session.length_unit
    mm = METRES["mm"] / METRES[unit]
    rotation = session.repeatability.sigma_rotation
    translation = session.repeatability.sigma_translation
    noise = session.scanner.noise
    assumed = list[str]()
    if translation is None:
        translation = USUAL_TRANSLATION * mm
        assumed.append(f"the flange scatters by {length_text(translation, unit)} per axis (robot.repeatability)")
    if rotation is None:
        rotation = USUAL_ROTATION
        assumed.append(f"the flange turns by {angle_text(rotation)} per axis (robot.repeatability)")
    if noise is None:
        noise = USUAL_NOISE * mm
        assumed.append(f"the scanner's noise is {length_text(noise, unit)} (scanner.noise)")
    return Scatter(rotation, translation, noise, USUAL_NOISE_FACTOR, {}, tuple(assumed))


@dataclass(frozen=True)
class FittedScatter:
    """How large the errors of some views are found to be."""

    fitted: Scatter  # at the maximum of the likelihood, which diagnosis takes
    believed: Scatter  # posterior mean, which the covariance of a hand-eye takes


def mean_scatter(linear: LinearModel, noise: float, variances: Sequence[tuple[Array, Array]]) -> FittedScatter:
    """The mean of fitted and believed variances (c,) of some fits of a linear model.

    Args:
        noise: of the scans.
    """
    scatters = []
    for mean in np.mean(variances, axis=0):
        rotation, translation = np.sqrt(mean[:NOISE])
        errors = dict(zip(linear.component_names, map(float, mean[NOISE + 1 :]), strict=True))
        scatters.append(Scatter(float(rotation), float(translation), noise, float(mean[NOISE]), errors))
    return FittedScatter(*scatters)


@dataclass(frozen=True)
class CellModel:
    """Everything about a cell but its views."""

    model: Model
    part: PlannedPart  # reference frame
    field: FieldOfView
    scatter: Scatter


@dataclass(frozen=True, repr=False)
class ExpectedModel(LinearModel):
    """A linear model of views that nobody has taken: nothing is fitted, the scatter is the one that is expected."""

    def refit(self) -> Self:
        """The variances that the remaining errors had in the model this was taken from."""
        source = self.full_model or self
        variance_of = dict(zip(source.component_names, source.null.variances[NOISE + 1 :], strict=True))
        kept = [variance_of[name] for name in self.component_names]
        return self.at(np.append(source.null.variances[: NOISE + 1], kept))

    def at(self, variances: Array) -> Self:
        """Return the model under other variances (c,)."""
        return replace(self, null=at_variances(self.mixed, variances), full_model=None)


@dataclass(frozen=True)
class SimulatedViews:
    """What planned views would see: their measurement, freed without a motion."""

    measurement: Measurement
    unconstrained: UnconstrainedPoses

    def field_middle(self, feature: Array | None = None) -> Array:
        """(3,) scanner frame: mean place of a feature (3,) of the reference frame; None: of all that the views see."""
        if feature is None:
            return np.mean([p.mean(axis=0) for p in self.measurement.capture.point_sets], axis=0)
        poses = self.unconstrained.poses
        return np.einsum("vji,vj->vi", poses[:, :3, :3], feature - poses[:, :3, 3]).mean(axis=0)


def expected_scans(cell: CellModel, T_reference_scanner: Array) -> list[Indices]:
    """Per pose (V, 4, 4) the points of the part that a view from there sees."""
    return [expected_scan(cell.part, T, cell.field) for T in T_reference_scanner]


def simulate_views(
    session: SessionData, cell: CellModel, samples: int = SAMPLES, fewest: int = FEWEST
) -> SimulatedViews:
    """Simulate what the views of a session would show, whatever clouds it has.

    Args:
        samples: points of every view that are matched; information is that of SAMPLES.
        fewest: points that a view must show.

    Raises:
        NoResultError: no two views would overlap.
    """
    session = replace(
        session,
        views=tuple(replace(view, cloud=None, sighting=None) for view in session.views),
        scanner=replace(session.scanner, standoff=cell.field.standoff),
    )
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    bare = build_capture(session.name, (), T_base_flange, session.mount)
    poses = bare.poses(cell.model.T_mount)
    shown = expected_scans(cell, poses)
    blind = next((view.name for view, index in zip(session.views, shown, strict=True) if len(index) < fewest), None)
    if blind is not None:
        raise NoResultError(
            f"view {blind} would see next to nothing of the part; to fix: check scanner.pose, scanner.standoff and the "
            "part, or leave the view out"
        )
    seen = [frames.transform(frames.inverse(T), cell.part.points[i]) for T, i in zip(poses, shown, strict=True)]
    scans = tuple(replace(prepare_scan("planned", points), noise=cell.scatter.noise) for points in seen)
    capture = replace(bare, scans=scans)
    measurement = with_part_origin(measurement_of(session, capture), cell.model.T_mount)
    return SimulatedViews(measurement, _unconstrained_poses(capture, poses, cell, samples))


def _unconstrained_poses(capture: Capture, poses: Array, cell: CellModel, samples: int) -> UnconstrainedPoses:
    gate = _SPACINGS * capture.spacing + _SIGMAS * cell.scatter.noise
    overlaps = collect_overlaps(capture, poses, gate, [sample_points(scan, samples) for scan in capture.scans])
    g = overlaps.gram
    # Distances between two points, each with the scanner's noise.
    more = SAMPLES / samples
    known = replace(
        g,
        matrix=more * g.matrix,
        weight=more * g.weight,
        square=2 * cell.scatter.noise**2 * more * g.weight,
        scale=float(np.sqrt(2)) * cell.scatter.noise,
    )
    return UnconstrainedPoses(poses, np.zeros((len(poses), 6)), replace(overlaps, gram=known))


def expected_model(simulated: SimulatedViews, cell: CellModel) -> ExpectedModel:
    """The linear model of planned views under the cell's model and scatter."""
    linear = surface_model(
        simulated.measurement,
        cell.model,
        simulated.measurement.capture,
        simulated.unconstrained,
        cell.scatter.variances,
    )
    return ExpectedModel(**{f.name: getattr(linear, f.name) for f in fields(linear)})


@dataclass(frozen=True)
class PlannedCell:
    """A cell, and in words what nobody stated of it."""

    cell: CellModel
    assumed: tuple[str, ...]
    fitted_scatter: FittedScatter | None = None  # errors that a run has found


def cell_of_session(
    session: SessionData, part: Path | None = None, size_mm: float | None = None, field_deg: float | None = None
) -> PlannedCell:
    """The cell as session.toml and the options describe it.

    Args:
        part: mesh, or cloud with normals, in length_unit; None: the session's CAD, or a block of `size_mm`.
        field_deg: full angle of the scanner's field.

    Raises:
        InputError: a session that does not say where the scanner sits or how far it sees, or an unknown part.
    """
    file = session.path / "session.toml"
    scanner = session.scanner
    if scanner.T_mount is None:
        raise InputError(f"{file}: no scanner.pose; to fix: state roughly where the scanner sits")
    if scanner.standoff is None:
        raise InputError(f"{file}: no scanner.standoff; to fix: state the distance from scanner to part")
    if scanner.kind not in (None, "area", "line"):
        raise InputError(f"{file}: scanner.kind is {scanner.kind}, not a scan; to fix: stitch run, then stitch next")
    scatter = stated_scatter(session)
    assumed = list[str]()
    half = np.tan(np.radians((field_deg or USUAL_FIELD_DEG) / 2))
    if field_deg is None:
        assumed.append(f"the scanner's field is {USUAL_FIELD_DEG:.0f}° wide (--field)")
    field = FieldOfView(
        half=np.array([half, half]),
        near=scanner.standoff * (1 - _DEPTH),
        far=scanner.standoff * (1 + _DEPTH),
        standoff=scanner.standoff,
        axis=scanner.optical_axis,
    )
    surface, words = _part_of_session(session, part, size_mm)
    cell = CellModel(Model(scanner.T_mount), surface, field, scatter)
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    poses = build_capture(session.name, (), T_base_flange, session.mount).poses(scanner.T_mount)
    counts = np.array([len(index) for index in expected_scans(cell, poses)])
    if words or np.mean(counts >= FEWEST) < 0.5:
        # Where nobody says where the part is, it is where the views look.
        looked_at = frames.transform(poses, (scanner.standoff * scanner.optical_axis)[None])[:, 0].mean(axis=0)
        cell = replace(cell, part=surface.moved(frames.make(np.eye(3), looked_at - surface.centre)))
        words += ["the part is where the views look"]
    return PlannedCell(cell, (*scatter.assumed, *assumed, *words))


def cell_of_run(state: RunData, folder: Path) -> PlannedCell:
    """The cell as a run found it: its model, its scatter, its fused cloud, the field that its scans fill.

    Raises:
        InputError: a run of labelled points, or one without its cloud.
    """
    if not state.session.has_clouds:
        raise InputError(f"{folder}: a run of labelled points, not of scans; to fix: stitch next {folder}")
    file = folder / "stitched.ply"
    cloud = read_cloud(file)
    if cloud.normals is None:
        raise InputError(f"{file}: has no normals; to fix: stitch run {state.session.path} -o {folder}")
    return cell_of_state(state, cloud.points, cloud.normals)


def cell_of_state(state: RunData, points: Array, normals: Array) -> PlannedCell:
    """Return the cell as a run found it.

    Args:
        points, normals: (N, 3) of its stitched cloud, reference frame, length_unit.
    """
    scans = state.measurement.capture.scans
    seen = np.concatenate([scan.points for scan in scans])
    reach = np.linalg.norm(seen, axis=1)
    slopes = np.abs(seen[:, :2] / seen[:, 2:])
    near, far = np.quantile(reach, [1 - _SEEN, _SEEN])
    field = FieldOfView(
        np.quantile(slopes, _SEEN, axis=0) * (1 + _MARGIN),
        float(near * (1 - _MARGIN)),
        float(far * (1 + _MARGIN)),
        standoff=state.measurement.views.standoff,
        axis=state.session.scanner.optical_axis,
    )
    noise = float(np.nanmedian([scan.noise for scan in scans]))
    linear = linear_model_of(state)
    scatter = mean_scatter(linear, noise, [(linear.null.variances, mean_variances(linear.mixed, linear.null))])
    return PlannedCell(CellModel(state.model, thinned_surface(points, normals), field, scatter.believed), (), scatter)


def _part_of_session(session: SessionData, part: Path | None, size_mm: float | None) -> tuple[PlannedPart, list[str]]:
    """The part's surface, and what is assumed of it."""
    unit = METRES[session.length_unit]
    if part is not None:
        return surface_of_file(part, 1.0), []
    if size_mm is not None:
        size = size_mm * METRES["mm"] / unit
        return block_surface(size), [f"the part is a block, {length_text(size, session.length_unit)} long (--part)"]
    if session.cad is not None:
        return surface_of_file(session.cad, METRES[session.cad_unit or session.length_unit] / unit), []
    raise InputError(
        f"{session.path}: the scanned part is not stated; to fix: --part MESH, or --size MM of its longest side"
    )


@dataclass(frozen=True)
class ExpectedHandEye:
    """What a fit of the hand-eye would state of itself."""

    covariance: Array  # (6, 6) of the right perturbation, scanner frame, rotation first
    shares: dict[str, float]  # of its variance, by source; they add up to 1
    middle: Array  # (3,) scanner frame, of what it sees or of a feature

    @property
    def U(self) -> float:
        """Expanded uncertainty (k = 2) of the place of `middle`, length_unit: one number for all six."""
        return displacement(self.covariance, self.middle)


def expected_hand_eye(
    linear: ExpectedModel, simulated: SimulatedViews, feature: Array | None = None
) -> ExpectedHandEye:
    """Predict `hand_eye_statistics`: least squares under the scatter alone, the covariance under all errors.

    Args:
        feature: (3,) reference frame: the place whose displacement U counts; None: the middle of what the views see.
    """
    sizes = linear.null.variances
    components = linear.mixed.components[:, 0]
    names = (*WHITE_COMPONENTS, *linear.component_names)
    columns = linear.reduce(linear.design)
    prior = weak_prior(
        [simulated.measurement.capture], [simulated.unconstrained], linear.model.T_mount, linear.sizes[6:]
    )
    scatter = np.einsum("c,cij->ij", sizes[: NOISE + 1], components[: NOISE + 1])
    gain, of_estimate = generalised_fit(scatter, columns, prior)
    sources = {name: size * gain @ C @ gain.T for name, size, C in zip(names, sizes, components, strict=True)}
    if linear.mixed.fixed is not None:
        field = (USUAL_SHARE / ALARM_SHARE) ** 2 * linear.mixed.fixed[0]
        sources["scanner field"] = gain @ field @ gain.T
    sources["unseen"] = of_estimate @ prior @ of_estimate
    covariance = np.sum(list(sources.values()), axis=0)
    # The hand-eye is what the first six rows are of; mean share of every source in its variance, over its directions.
    scaled, unit = equilibrated(covariance[:6, :6])
    weight = np.linalg.inv(scaled) * np.outer(unit, unit)
    shares = {name: float(np.sum(weight * part[:6, :6])) / 6 for name, part in sources.items()}
    return ExpectedHandEye(covariance[:6, :6], shares, simulated.field_middle(feature))


def expected_scatter(linear: ExpectedModel, noise: float) -> FittedScatter:
    """Return what runs of these views would find, on average, under the expected scatter.

    Args:
        noise: of the scans.
    """
    draws = next((count for size, count in _DRAWS if linear.mixed.size <= size), 0)
    if not draws or linear.pose_errors is None:
        return mean_scatter(linear, noise, [(linear.null.variances, linear.null.variances)])
    half = np.linalg.cholesky(linear.covariance[0])
    rng = np.random.default_rng(0)
    fits = []
    for _ in range(draws):
        mixed = replace(linear.mixed, z=(half @ rng.standard_normal(len(half)))[None])
        null = fit_variances(mixed, both_starts=True)
        fits.append((null.variances, mean_variances(mixed, null)))
    return mean_scatter(linear, noise, fits)


def with_scatter(linear: ExpectedModel, scatter: Scatter) -> ExpectedModel:
    """Return the same views under another scatter."""
    return linear.at(scatter.variances(linear.component_names))

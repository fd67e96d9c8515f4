"""Planned views as a linear model: what their scans would say, with the scatter that is expected of them."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture, build_capture
from stitch.measurement.measurement import Measurement, measurement_of, with_part_origin
from stitch.measurement.scan import Scan, prepare_scan
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.free_poses import SAMPLES, UnconstrainedPoses
from stitch.observations.surfaces.match import sample_points
from stitch.observations.surfaces.overlaps import collect_overlaps
from stitch.observations.surfaces.surface_model import surface_model
from stitch.planning.expected_scan import FieldOfView, expected_scan
from stitch.planning.planned_part import PlannedPart
from stitch.planning.scatter import Scatter
from stitch.statistics.variance_components import at_variances
from stitch.statistics.variance_prior import NOISE

_SPACINGS, _SIGMAS = 1.5, 6.0  # of the gate
# Fewer points of a view say nothing of six directions.
FEWEST = 60


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

    def refitted(self) -> Self:
        """The variances that the remaining errors had in the model this was taken from."""
        source = self.full_model or self
        assert source.pose_errors is not None and self.pose_errors is not None
        own = dict(zip(source.pose_errors.names, source.null.variances[NOISE + 1 :], strict=True))
        kept = [own[name] for name in self.pose_errors.names]
        return self.at(np.append(source.null.variances[: NOISE + 1], kept))

    def at(self, variances: Array) -> Self:
        """The same under other variances (c,)."""
        return replace(self, null=at_variances(self.mixed, variances), full_model=None)


@dataclass(frozen=True)
class SimulatedViews:
    """What planned views would see: their measurement, freed without a motion."""

    measurement: Measurement
    unconstrained: UnconstrainedPoses


def expected_scans(cell: CellModel, T_reference_scanner: Array) -> list[Indices]:
    """Per pose (V, 4, 4) the points of the part that a view from there sees."""
    return [expected_scan(cell.part, T, cell.field) for T in T_reference_scanner]


def simulate_views(session: Session, cell: CellModel, samples: int = SAMPLES, fewest: int = FEWEST) -> SimulatedViews:
    """What the views of a session would show, whatever clouds it has.

    Args:
        samples: points of every view that are matched; information is that of SAMPLES.
        fewest: points that a view must show.

    Raises:
        NoResultError: no two views would overlap.
    """
    session = _without_scans(session, cell.field.standoff)
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    bare = build_capture(session.name, (), T_base_flange, session.mount)
    poses = bare.poses(cell.model.T_mount)
    shown = expected_scans(cell, poses)
    blind = next((view.name for view, index in zip(session.views, shown, strict=True) if len(index) < fewest), None)
    if blind is not None:
        raise NoResultError(
            f"view {blind} would see next to nothing of the part; check scanner.pose, scanner.standoff and the part, "
            "or leave the view out"
        )
    scans = tuple(_simulated_scan(cell, T, index) for T, index in zip(poses, shown, strict=True))
    capture = replace(bare, scans=scans)
    measurement = with_part_origin(measurement_of(session, capture), cell.model.T_mount)
    return SimulatedViews(measurement, _unconstrained_poses(capture, poses, cell, samples))


def _without_scans(session: Session, standoff: float) -> Session:
    """The session without what it has seen."""
    views = tuple(replace(view, cloud=None, sighting=None) for view in session.views)
    return replace(session, views=views, scanner=replace(session.scanner, standoff=standoff))


def _simulated_scan(cell: CellModel, T_reference_scanner: Array, index: Indices) -> Scan:
    points = frames.transform(frames.inverse(T_reference_scanner), cell.part.points[index])
    return replace(prepare_scan("planned", points), noise=cell.scatter.noise)


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

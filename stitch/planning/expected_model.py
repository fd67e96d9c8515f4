"""Planned views as a linear model: what their scans would say, with the scatter that is expected of them."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array, Indices
from stitch.measurement.capture import Capture, place
from stitch.measurement.measurement import Measurement, about_part, measurement_of
from stitch.measurement.scan import Scan, prepare_view
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.free_poses import SAMPLES, FreePoses
from stitch.observations.surfaces.match import sample
from stitch.observations.surfaces.overlaps import collect
from stitch.observations.surfaces.surface_model import surface_model
from stitch.planning.expected_scan import Field, expected_scan
from stitch.planning.planned_part import PlannedPart
from stitch.planning.scatter import Scatter
from stitch.statistics.variance_components import at_variances
from stitch.statistics.variance_prior import NOISE

_SPACINGS, _SIGMAS = 1.5, 6.0  # of the gate
# Fewer points of a view say nothing of six directions.
FEWEST = 60


@dataclass(frozen=True)
class Cell:
    """Everything about a cell but its views."""

    model: Model
    part: PlannedPart  # reference frame
    field: Field
    scatter: Scatter


@dataclass(frozen=True, repr=False)
class ExpectedModel(LinearModel):
    """A linear model of views that nobody has taken: nothing is fitted, the scatter is the one that is expected."""

    def refitted(self) -> Self:
        """The variances that the remaining errors had in the model this was taken from."""
        source = self.whole or self
        assert source.pose_errors is not None and self.pose_errors is not None
        own = dict(zip(source.pose_errors.names, source.null.variances[NOISE + 1 :], strict=True))
        kept = [own[name] for name in self.pose_errors.names]
        return self.at(np.append(source.null.variances[: NOISE + 1], kept))

    def at(self, variances: Array) -> Self:
        """The same under other variances (c,)."""
        return replace(self, null=at_variances(self.mixed, variances), whole=None)


@dataclass(frozen=True)
class Seen:
    """What planned views would see: their measurement, freed without a motion."""

    measurement: Measurement
    freed: FreePoses


def expected_scans(cell: Cell, T_reference_scanner: Array) -> list[Indices]:
    """Per pose (V, 4, 4) the points of the part that a view from there sees."""
    return [expected_scan(cell.part, T, cell.field) for T in T_reference_scanner]


def seen(session: Session, cell: Cell, samples: int = SAMPLES, fewest: int = FEWEST) -> Seen:
    """What the views of a session would show, whatever clouds it has.

    Args:
        samples: points of every view that are matched; information is that of SAMPLES.
        fewest: points that a view must show.

    Raises:
        NoResultError: no two views would overlap.
    """
    session = _bare(session, cell.field.standoff)
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    bare = place(session.name, (), T_base_flange, session.mount)
    poses = bare.poses(cell.model.T_mount)
    shown = expected_scans(cell, poses)
    blind = next((view.name for view, index in zip(session.views, shown, strict=True) if len(index) < fewest), None)
    if blind is not None:
        raise NoResultError(
            f"view {blind} would see next to nothing of the part; check scanner.pose, scanner.standoff and the part, "
            "or leave the view out"
        )
    scans = tuple(_scan(cell, T, index) for T, index in zip(poses, shown, strict=True))
    capture = replace(bare, scans=scans)
    measurement = about_part(measurement_of(session, capture), cell.model.T_mount)
    return Seen(measurement, _freed(capture, poses, cell, samples))


def _bare(session: Session, standoff: float) -> Session:
    """The session without what it has seen."""
    views = tuple(replace(view, cloud=None, sighting=None) for view in session.views)
    return replace(session, views=views, scanner=replace(session.scanner, standoff=standoff))


def _scan(cell: Cell, T_reference_scanner: Array, index: Indices) -> Scan:
    points = frames.transform(frames.inverse(T_reference_scanner), cell.part.points[index])
    return replace(prepare_view("planned", points), noise=cell.scatter.noise)


def _freed(capture: Capture, poses: Array, cell: Cell, samples: int) -> FreePoses:
    gate = _SPACINGS * capture.spacing + _SIGMAS * cell.scatter.noise
    overlaps = collect(capture, poses, gate, [sample(scan, samples) for scan in capture.scans])
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
    return FreePoses(poses, np.zeros((len(poses), 6)), replace(overlaps, gram=known))


def expected_model(found: Seen, cell: Cell) -> ExpectedModel:
    """The linear model of planned views under the cell's model and scatter."""
    linear = surface_model(
        found.measurement, cell.model, found.measurement.capture, found.freed, cell.scatter.variances
    )
    return ExpectedModel(**{f.name: getattr(linear, f.name) for f in fields(linear)})

"""`stitch.plan`: what `stitch plan` does, of a session or a run in memory."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, overload

import numpy as np

from stitch.api.verbs import stored_cloud, stored_state
from stitch.errors import InputError
from stitch.plugins.metrology.planning.drive import DrivenCell
from stitch.plugins.metrology.planning.expected_model import PlannedCell, cell_of_session, cell_of_state
from stitch.plugins.metrology.planning.plan import Plan, plan_further_views, plan_request
from stitch.run_data import RunData
from stitch.session.session import SessionData


@overload
def plan(
    cell: Path | str,
    *,
    until_U: float,
    part: Path | str | None = None,
    size: float | None = None,
    field: float | None = None,
    start: Any = None,
) -> Iterator[dict[str, Any]]: ...


@overload
def plan(
    cell: SessionData | RunData,
    *,
    views: int | None = None,
    split: tuple[str, str] | None = None,
    halve: bool = False,
    feature: Any = None,
    part: Path | str | None = None,
    size: float | None = None,
    field: float | None = None,
) -> Plan: ...


def plan(
    cell: SessionData | RunData | Path | str,
    *,
    views: int | None = None,
    split: tuple[str, str] | None = None,
    halve: bool = False,
    feature: Any = None,
    part: Path | str | None = None,
    size: float | None = None,
    field: float | None = None,
    until_U: float | None = None,
    start: Any = None,
) -> Plan | Iterator[dict[str, Any]]:
    """Compute what views would show before they are taken, and which further ones help most, as `stitch plan` does.

    Args:
        cell: a run, which knows its cell, or a session whose views are planned.
        views: at most so many further ones.
        split: two effects that they are to tell apart.
        halve: they are to halve the uncertainty of the hand-eye and nothing else.
        feature: (3,) at which the uncertainty counts, reference frame, length_unit; or (6,) with a normal, along it.
        part: mesh, or cloud with normals, of a session's part.
        size: its longest side, mm, where nothing else is known.
        field: full angle of the scanner's field, degrees.
        until_U: with the folder of a session as `cell`: the poses, one after the other, at which a view brings most,
            until U (k = 2) of the hand-eye at the part is reached, length_unit, or nothing is gained. Whoever takes
            them writes scan and row into the session before the next; a pose of which there is no row is out of reach.
        start: (n,) joint angles, rad, of the first view, where there is none.

    Returns:
        `now`, `proposed` with joints (n,) in rad and T_base_flange (4, 4) in length_unit, and `after`.

    Raises:
        InputError: an effect that is not known, or a cell of which too little is.

    Example:
        >>> outlook = stitch.plan(run, views=2).now
        >>> outlook.views
        5
    """
    if isinstance(cell, Path | str):
        if until_U is None:
            raise InputError(f"stitch.plan: {cell} is a path; to fix: until_U=…, or pass stitch.load_session(…)")
        mesh = None if part is None else Path(part)
        joints = None if start is None else np.asarray(start, float)
        return DrivenCell(Path(cell), mesh, size, field, joints).poses(until_U, lambda *_: None)
    at = None if feature is None else np.asarray(feature, float).reshape(-1)
    wanted = plan_request(views, split, halve, at)
    if isinstance(cell, RunData):
        return plan_further_views(cell.session, _cell_of_run(cell), wanted)
    planned = cell_of_session(cell, None if part is None else Path(part), size, field)
    return plan_further_views(cell, planned, wanted)


def _cell_of_run(run: RunData) -> PlannedCell:
    if not run.session.has_clouds:
        raise InputError(f"{run.session.name}: a run of labelled points; plans are made for scans; to fix: diagnose it")
    cloud = stored_cloud(run)
    return cell_of_state(stored_state(run), cloud.points, cloud.normals)

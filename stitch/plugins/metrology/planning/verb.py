"""`stitch.plan`: what `stitch plan` does, of a session or a run in memory."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.api.verbs import stored_cloud, stored_state
from stitch.errors import InputError
from stitch.plugins.metrology.planning.expected_model import PlannedCell, cell_of_session, cell_of_state
from stitch.plugins.metrology.planning.plan import Plan, plan_further_views, plan_request
from stitch.run_data import RunData
from stitch.session.session import SessionData


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
) -> Plan:
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

    Returns:
        `now`, `proposed` with joints (n,) in rad and T_base_flange (4, 4) in length_unit, and `after`.

    Raises:
        InputError: an effect that is not known, or a cell of which too little is.

    Example:
        >>> outlook = stitch.plan(run, views=2).now
        >>> outlook.views
        5
    """
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

"""`stitch.plan`: what `stitch plan` does, of a session or a run in memory; and a plan as JSON and as a table."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, overload

import numpy as np

from stitch.api.verbs import stored_cloud
from stitch.errors import InputError
from stitch.model.model import expanded_uncertainty
from stitch.numerics.frames import Array
from stitch.output.session_files import pose_columns
from stitch.plugins.metrology.planning.detection_chances import EffectOutlook, Outlook
from stitch.plugins.metrology.planning.drive import DrivenCell
from stitch.plugins.metrology.planning.expected_model import (
    ExpectedHandEye,
    PlannedCell,
    cell_of_session,
    cell_of_state,
)
from stitch.plugins.metrology.planning.plan import Plan, ProposedView, plan_further_views, plan_request
from stitch.run_data import RunData
from stitch.session.session import SessionData

FORMAT = "stitch-plan/1"


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
    return cell_of_state(run, cloud.points, cloud.normals)


def plan_document(plan: Plan, T_mount: Array) -> dict[str, Any]:
    """A plan as a dictionary; lengths in length_unit, angles in rad, what cannot be known null."""
    return {
        "format": FORMAT,
        "session": plan.session.name,
        "length_unit": plan.session.length_unit,
        "mount_frame": "base" if plan.session.mount == "eye_to_hand" else "flange",
        "assumed": list(plan.assumed),
        "split": None if plan.split is None else list(plan.split),
        "now": None if plan.now is None else _outlook(plan.now, T_mount),
        "proposed": [_proposed(view) for view in plan.proposed],
        "after": None if plan.after is None else _outlook(plan.after, T_mount),
    }


def _outlook(o: Outlook, T_mount: Array) -> dict[str, Any]:
    return {
        "views": o.views,
        "hand_eye": _hand_eye(o.hand_eye, T_mount) | {"shares": o.hand_eye.shares},
        "hand_eye_of_an_ordinary_arm": _hand_eye(o.ordinary, T_mount),
        "effects": [_effect(e) for e in o.effects],
        "pairs": [{"effects": [p.a, p.b], "identifiable": {p.a: p.size_a, p.b: p.size_b}} for p in o.pairs],
        "not_asked": {name: list(needs) for name, needs in o.untestable.items()},
    }


def _hand_eye(expected: ExpectedHandEye, T_mount: Array) -> dict[str, Any]:
    """U (k = 2) of rotation vector and position in the mount frame, as `run` prints it, and at the part."""
    return {"U": expanded_uncertainty(T_mount, expected.covariance).tolist(), "U_at_part": expected.U}


def _effect(e: EffectOutlook) -> dict[str, Any]:
    return {
        "effect": e.name,
        "observable": e.observable,
        "multiple_detectable": e.multiple,
        "minimum_detectable": {
            name: {"size": size, "usual": e.usual[name], "unit": e.units[name]} for name, size in e.detectable.items()
        },
        "chance_detected": getattr(e.chance, "detected", None),
        "chance_named": getattr(e.chance, "named", None),
        "chance_misnamed": getattr(e.chance, "misnamed", None),
        "taken_for": getattr(e.chance, "taken_for", None),
    }


def _proposed(view: ProposedView) -> dict[str, Any]:
    return {
        "view": view.name,
        "joints_deg": np.round(np.degrees(view.joints), 3).tolist(),
        "pose": view.T_base_flange.tolist(),
        "travel_deg": round(float(np.degrees(view.travel)), 1),
        "U_at_part": view.U,
        "told_apart": view.separated_share,
    }


def view_columns(plan: Plan) -> dict[str, Any]:
    """Columns of the further views, in the order in which they are driven: view, joints, pose."""
    joints = np.degrees([view.joints for view in plan.proposed])
    poses = pose_columns(np.array([view.T_base_flange for view in plan.proposed]))
    angles = {f"j{i + 1}_deg": column.round(4) for i, column in enumerate(joints.T)}
    return {"view": [view.name for view in plan.proposed], **angles, **poses}

"""A plan as JSON, and its further views as a table like views.csv."""

from typing import Any

import numpy as np

from stitch.model.model import expanded_uncertainty
from stitch.numerics.frames import Array
from stitch.output.session_files import pose_columns
from stitch.plugins.metrology.planning.detection_chances import EffectOutlook, Outlook
from stitch.plugins.metrology.planning.expected_model import ExpectedHandEye
from stitch.plugins.metrology.planning.plan import Plan, ProposedView

FORMAT = "stitch-plan/1"


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

"""Further views of a session that is planned: joint angles in which the scanner would see the part."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis.candidate_views import drawn_until, reachable
from stitch.numerics.frames import Array
from stitch.plugins.metrology.planning.expected_model import FEWEST, CellModel, expected_scans
from stitch.session.axis_poses import carried_last
from stitch.session.capture import build_capture
from stitch.session.robot import forward
from stitch.session.session import SessionData, View

# A view must show this share of what the others show.
_SHARE = 0.4
# So many times as many poses are tried as are asked for.
_TRIES = 4
# More poses are drawn until there are this share of those that are asked for.
_ENOUGH = 1 / 6


def with_views(session: SessionData, joints: Sequence[Array], in_turn: bool = True) -> SessionData:
    """The session with further views at joint angles (n,) rad, after the last one, called p01, p02 …

    Args:
        in_turn: each driven to from the one before; else each from the last view that there is, one of them being next.
    """
    assert session.robot is not None
    last, views = session.views[-1], list(session.views)
    # External axes stay where they were last.
    carried = carried_last(session)
    times = [view.time_s for view in views if view.time_s is not None]
    pause = float(np.median(np.diff(times))) if len(times) > 1 else 60.0
    for k, q in enumerate(joints):
        before = views[-1] if in_turn else last
        assert before.joints is not None
        # As alternatives they come at times that a few views would take.
        later = pause * (k + 1 if in_turn else k % 6 + 1)
        views.append(
            View(
                name=f"p{k + 1:02d}",
                cloud=None,
                T_base_flange=carried[0] @ forward(session.robot, q),
                joints=q,
                approach=np.sign(q - before.joints),
                time_s=None if last.time_s is None else last.time_s + later,
                covariates=dict(last.covariates),
            )
        )
    return replace(session, views=tuple(views))


def candidate_joints(session: SessionData, cell: CellModel, count: int, chosen: Array | None = None) -> Array:
    """(K, n) joint angles near those that are planned, or closer to chosen ones (C, n), in which the scanner would see
    the part, K ≤ count."""
    T_mount = cell.model.T_mount
    driven, T_base_flange = session.joints, np.array([view.T_base_flange for view in session.views])
    assert driven is not None

    def poses_of(joints: Array) -> Array:
        assert session.robot is not None
        T = carried_last(session) @ forward(session.robot, joints)
        return build_capture(session.name, (), T, session.mount).poses(T_mount)

    seen_from = build_capture(session.name, (), T_base_flange, session.mount).poses(T_mount)
    least = max(FEWEST, _SHARE * np.median([len(index) for index in expected_scans(cell, seen_from)]))

    def seeing(seed: int) -> Array:
        """Return random joint angles (k, n) in which the scanner would see enough of the part."""
        joints = reachable(driven, poses_of, seen_from, cell.part.centre, chosen, seed)[: _TRIES * count]
        return joints[[len(index) >= least for index in expected_scans(cell, poses_of(joints))]]

    # About a single view the part is hardly ever in its place again: random angles are drawn anew then.
    return drawn_until(seeing, _ENOUGH * count)[:count]

"""An arm as a table of links: fitted for what such a table can hold, and proved by reading it back.

Offsets and links of a model are right beside its compliance and its gears, which no table holds; without these they may
leave more than the nominal arm does. So the table is fitted alone. The proof: fitted without a part of the views, it is
written and read back, and that part is run with it and with the nominal arm, base and tool fitted anew for either.
"""

import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stitch import frames
from stitch.calibrate.robot_calibration import with_geometry
from stitch.calibrate.robot_table import robot_toml
from stitch.errors import InputError, NoResultError
from stitch.frames import Array
from stitch.measurement.robot import Robot, forward
from stitch.measurement.session import Session, View
from stitch.pipeline import run
from stitch.reading.dh_rows import robot_from_dh
from stitch.reading.urdf import robot_from_urdf
from stitch.statistics.shares import significantly_smaller
from stitch.units import length_text
from stitch.writing.urdf_file import to_urdf

# What a table can hold, alone and together.
_CHOICES = (("joint_offset",), ("link_geometry",), ("joint_offset", "link_geometry"))
# Parts of the views that are left out in turn, each of blocks of neighbours in time from all over the session.
_PARTS, _BLOCKS = 4, 16
_CHANCE = 0.01  # that a table which is no better than the nominal arm is said to be


@dataclass(frozen=True)
class LinkTable:
    """The arm that is written, and what proves it; rms of targets in views that took no part, length_unit."""

    robot: Robot
    effects: tuple[str, ...]  # in it; none: the nominal arm
    heldout_rms: float = np.nan
    nominal_rms: float = np.nan

    def sentence(self, unit: str) -> str:
        """What the table is worth."""
        if np.isnan(self.nominal_rms):
            return "These views are too few to prove a table of links on a part of them: it is that of the nominal arm."
        here, nominal = length_text(self.heldout_rms, unit), length_text(self.nominal_rms, unit)
        if not self.effects:
            return (
                f"No table of links is better than the nominal one: read back, the best leaves {here} in views left "
                f"out, the nominal {nominal}; it is that of the nominal arm."
            )
        return f"Fitted for the table alone and read back, it leaves {here} in views left out, the nominal {nominal}."


def link_table(session: Session) -> LinkTable:
    """The table that leaves least in views that took no part in it; the nominal one where none leaves clearly less.

    Raises:
        InputError: the session has no robot with joints.
    """
    nominal = session.robot
    if nominal is None:
        raise InputError(f"{session.path}: no [robot]; a table of its links needs one")
    left = {choice: rms for choice in _CHOICES if np.isfinite(rms := _heldout_rms(session, choice))}
    plain = _heldout_squares(session, ())
    best = min(left, key=lambda choice: left[choice]) if left else ()
    judged = _heldout_squares(session, best)
    if judged is None or plain is None:
        return LinkTable(nominal, ())
    here, before = (float(np.sqrt(np.nanmean(squares))) for squares in (judged, plain))
    if not best or not significantly_smaller(judged, plain, _CHANCE / len(left)):
        return LinkTable(nominal, (), here, before)
    return LinkTable(with_geometry(nominal, run(session, effects=best).terms), best, here, before)


def _heldout_rms(session: Session, effects: Sequence[str]) -> float:
    """What they leave in views left out; NaN where the session cannot have them."""
    try:
        return run(session, effects=effects).heldout_rms
    except (InputError, NoResultError):
        return float("nan")


def _heldout_squares(session: Session, effects: Sequence[str]) -> Array | None:
    """(V,) mean squares of the targets' distances in every view, with the table of the other parts; NaN where none was
    seen. None where a part is too little for it."""
    count = len(session.views)
    part = np.arange(count) * min(_BLOCKS, count) // count % _PARTS
    squares = np.full(count, np.nan)
    number = {view.name: k for k, view in enumerate(session.views)}
    try:
        for k in range(_PARTS):
            table = _read_back(_fit_table(_session_of_views(session, part != k), effects), session.length_unit)
            judged = run(_with_reported_arm(_session_of_views(session, part == k), table))
            squares[[number[view.name] for view in judged.session.views]] = judged.view_rms**2
    except (InputError, NoResultError):
        return None
    return squares


def _session_of_views(session: Session, keep: Array) -> Session:
    return replace(session, views=tuple(view for view, kept in zip(session.views, keep, strict=True) if kept))


def _fit_table(session: Session, effects: Sequence[str]) -> Robot:
    assert session.robot is not None
    return with_geometry(session.robot, run(session, effects=effects).terms) if effects else session.robot


def _read_back(robot: Robot, unit: str) -> Robot:
    """As its file says: rows where it has them, else URDF."""
    text = robot_toml(robot)
    if text is not None:
        table = tomllib.loads(text)["robot"]
        payload = table.get("payload")
        return robot_from_dh(table["name"], table["dh"], table["joints"], payload, np.array(table["gravity"]), unit)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.urdf"
        file.write_text(to_urdf(robot), encoding="utf-8")
        return robot_from_urdf(file, "base_link", "flange", unit, robot.gravity)


def _with_reported_arm(session: Session, robot: Robot) -> Session:
    """As the arm of a table would have reported its poses; what a controller corrects beside its table, stays."""
    assert session.robot is not None
    nominal = session.robot

    def moved(view: View) -> View:
        assert view.joints is not None
        before, after = forward(nominal, view.joints), forward(robot, view.joints)
        return replace(view, T_base_flange=view.T_base_flange @ frames.inverse(before) @ after)

    return replace(session, robot=robot, views=tuple(map(moved, session.views)))

"""`stitch.check`: what a session holds, and what is wrong with it, as `stitch check` says."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.api.session import load_session
from stitch.screening.deep_check import deep_check
from stitch.screening.problems import SessionProblem
from stitch.session.notes import session_notes
from stitch.session.session import SessionData
from stitch.system.values import Table


@dataclass(frozen=True, eq=False)
class CheckedSession(Table, table="problems"):
    """Contents of a session, and what is wrong with it.

    Example:
        >>> checked = stitch.check(session)
        >>> checked.holds["views"], checked.problems, checked.ok
        (5, (), True)
    """

    holds: dict[str, Any]  # as `stitch check --json` prints it
    problems: tuple[SessionProblem, ...] = ()

    @property
    def ok(self) -> bool:
        """False where something is wrong for certain."""
        return not any(problem.certain for problem in self.problems)


def check(session: SessionData | Path | str, *, deep: bool = True) -> CheckedSession:
    """Return what a session holds and what is wrong with it, as `stitch check --deep` does.

    Args:
        session: one in memory, or its folder.
        deep: also try out what people do wrong: pairing, conventions, units, views.

    Returns:
        `holds`, with `median_range` in length_unit, and `problems`, each with its views and how to fix it.

    Raises:
        InputError: the folder cannot be read.

    Example:
        >>> stitch.check(session_folder).ok
        True
    """
    loaded = session if isinstance(session, SessionData) else load_session(session)
    return CheckedSession(session_summary(loaded), tuple(deep_check(loaded)) if deep else ())


def session_summary(session: SessionData) -> dict[str, Any]:
    """Return the contents of a session as `stitch check --json` prints them.

    `median_range` is the median over the views of the median distance of their points from the sensor, length_unit.
    It is None without points. Labelled points stand in for it where there are no clouds.
    """
    clouds = [view.cloud.points for view in session.views if view.cloud is not None]
    sighted = [view.sighting.points for view in session.views if view.sighting is not None]
    ranges = [float(np.median(np.linalg.norm(points, axis=1))) for points in clouds or sighted]
    return {
        "session": session.name,
        "mount": session.mount,
        "length_unit": session.length_unit,
        "views": len(session.views),
        "points": sum(view.cloud.count for view in session.views if view.cloud is not None),
        "targets": len({name for view in session.views if view.sighting for name in view.sighting.targets}),
        "sightings": sum(len(view.sighting.targets) for view in session.views if view.sighting),
        "median_range": round(float(np.median(ranges)), 3) if ranges else None,
        "joints": bool(session.views) and session.views[0].joints is not None,
        "robot": session.robot.name if session.robot else None,
        "hand_eye_given": session.scanner.T_mount is not None,
        "covariates": sorted({name for view in session.views for name in view.covariates}),
        "notes": session_notes(session),
    }

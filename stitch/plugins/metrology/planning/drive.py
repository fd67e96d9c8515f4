"""`stitch plan SESSION --drive COMMAND --until-U LENGTH`: views are taken where they bring most, until U is reached.

The command gets one JSON object on standard input, a pose as `stitch next --json` has it, and whose it is:

    {"session": "/cells/blade-18", "view": "d004", "joints_deg": […], "T_base_flange": [[…4],…]}

It drives there, scans, writes the scan and its row of views.csv into the session, and ends with exit code 0, or 3 where
the robot cannot reach the pose or nothing is seen from it: another is sought. A scan that shows nothing is taken for
that too, and its row is taken out again. After each view the session is run. What was scanned stands in the session: a
call that was cut short goes on where it ended.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.api.verbs import run as run_session
from stitch.api.verbs import stored_cloud
from stitch.errors import NoResultError, NothingMeasuredError
from stitch.model.model import displacement
from stitch.numerics.frames import Array
from stitch.observations.observability import seen_part
from stitch.plugins.metrology.planning.expected_model import cell_of_session, cell_of_state
from stitch.plugins.metrology.planning.plan import best_further_view
from stitch.run_data import RunData
from stitch.session.reading.csv_files import read_csv_rows
from stitch.session.reading.session_folder import load_session
from stitch.session.robot import forward
from stitch.session.session import SessionData
from stitch.system.files import whole_file
from stitch.system.programs import UnreachableError, call_program

# Fewer views say nothing of how well the hand-eye is known, and after so many no run may fail.
_FIRST, _MUST_RUN = 4, 8
# So many views that have brought less than this share of U are the last; of few views U is itself hardly known.
_PATIENCE, _GAIN = 6, 0.05

# Views that are there, U at the part (None where it is not known yet), and why the last pose gave none, if so.
Tell = Callable[[int, float | None, str], object]


@dataclass(frozen=True)
class DrivenCell:
    """A session folder that grows, and what it does not say of itself (`stitch plan`)."""

    folder: Path
    part: Path | None = None
    size: float | None = None
    field: float | None = None
    start: Array | None = None  # (n,) rad, where no view is there yet
    most: int = 40  # views

    def poses(self, until_U: float, tell: Tell) -> Iterator[dict[str, Any]]:
        """Yield poses until U of the hand-eye at the part is reached, or nothing is gained.

        A pose after which the session has no further view, or one whose scan shows nothing, is not proposed again.

        Args:
            until_U: expanded uncertainty (k = 2), length_unit.
            tell: is called after each pose.

        Raises:
            InputError: a session that cannot be read.
            NoResultError: many views, and no run of them.
        """
        refused = list[Array]()
        known = list[float]()
        without_view = ""
        while True:
            session, run = self._measured()
            count = 0 if session is None else len(session.views)
            known += [np.nan if run is None else _U_at_part(run)] * (len(known) < count)
            if count or without_view:
                tell(count, known[-1] if run is not None else None, without_view)
            if run is not None and (known[-1] <= until_U or count >= self.most or _nothing_gained(known)):
                return
            joints = self._next_joints(session, run, refused)
            if joints is None:
                return
            robot = load_session(self.folder, scans=False, start=joints).robot
            assert robot is not None
            view = f"d{count:03d}"
            yield {
                "session": str(self.folder.resolve()),
                "view": view,
                "joints_deg": np.degrees(joints).tolist(),
                "T_base_flange": forward(robot, joints[None])[0].tolist(),
            }
            without_view = self._why_no_view(view, count)
            if without_view:
                refused.append(joints)

    def _count(self) -> int:
        there = (self.folder / "views.csv").is_file()
        return len(load_session(self.folder, scans=False).views) if there else 0

    def _why_no_view(self, name: str, before: int) -> str:
        """Return why no view came of a pose, in words, or ""; the row of a scan that shows nothing goes."""
        another = "another pose is sought"
        if self._count() <= before:
            return f"{name}: out of reach, or nothing is seen from there; {another}"
        table = self.folder / "views.csv"
        last = read_csv_rows(table)[1][-1]
        try:
            load_session(self.folder, only=last["view"])
        except NothingMeasuredError:
            rows_before = table.read_bytes().splitlines(keepends=True)[: last.line - 1]
            with whole_file(table) as scratch:
                scratch.write_bytes(b"".join(rows_before))
            if not before:
                table.unlink()
            return f"{last['view']}: its scan shows nothing, and its row is taken out of views.csv; {another}"
        return ""

    def _measured(self) -> tuple[SessionData | None, RunData | None]:
        """Return the session, and its run; None where there is none yet."""
        if not self._count():
            return None, None
        session = load_session(self.folder)
        if len(session.views) < _FIRST:
            return session, None
        try:
            return session, run_session(session)
        except NoResultError:
            if len(session.views) >= _MUST_RUN:
                raise
            return session, None

    def _next_joints(self, session: SessionData | None, run: RunData | None, refused: list[Array]) -> Array | None:
        """Return joints (n,) rad of the view that is worth most; None where none is worth anything."""
        if session is None:
            assert self.start is not None
            return None if refused else self.start
        if run is None:
            planned = cell_of_session(session, self.part, self.size, self.field)
        else:
            cloud = stored_cloud(run)
            planned = cell_of_state(run, cloud.points, cloud.normals)
        return best_further_view(session if run is None else run.session, planned, refused)


def _nothing_gained(known: list[float]) -> bool:
    earlier = [U for U in known[:-_PATIENCE] if np.isfinite(U)]
    return bool(earlier) and min(known[-_PATIENCE:]) > (1 - _GAIN) * min(earlier)


def _U_at_part(run: RunData) -> float:
    return displacement(run.mount_covariance, seen_part([run.measurement.capture])[0])


def drive(cell: DrivenCell, until_U: float, command: str, seconds: float, tell: Tell) -> None:
    """Take views by a command until U is reached, or nothing is gained.

    Raises:
        NoResultError: the command fails, takes too long or writes no view; what was scanned stays.
    """
    for pose in cell.poses(until_U, tell):
        before = int(pose["view"][1:])
        try:
            call_program("--drive", command, pose, seconds)
        except UnreachableError:
            continue
        if cell._count() <= before:
            raise NoResultError(
                f"--drive {command}: returned 0, and {cell.folder} has no further view; to fix: write the scan and its "
                "row of views.csv, or return 3"
            )

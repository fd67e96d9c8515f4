"""A run as people hold it: hand-eye, stitched cloud, views, residuals, and what is drawn and written of them."""

import html
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np

from stitch.api.session import Session, public_session
from stitch.errors import InputError
from stitch.model.model import COVERAGE_FACTOR, displacement
from stitch.numerics.frames import Array
from stitch.numerics.units import MILLIMETRES
from stitch.output import run_folder
from stitch.output.cloud_colours import Colours, residual_colours
from stitch.output.fit_report import fit_report
from stitch.output.json_file import to_json
from stitch.output.result_document import effects_source, ledger, points_of
from stitch.output.run_folder import residual_table
from stitch.output.stored_run import read_ledger
from stitch.recorder import Recorder, RecorderMemory, SilentRecorder
from stitch.run_data import FusedCloud, RunData, StageResult
from stitch.session.capture import Capture
from stitch.session.reading.session_folder import content_hash, measured_files
from stitch.session.session import SessionData
from stitch.system.open3d_library import import_open3d
from stitch.system.values import Value

_LOG = logging.getLogger("stitch")


class AtPart(NamedTuple):
    """Expanded uncertainty U (k = 2) over all directions.

    Example:
        >>> mm, mrad = run.hand_eye.U
        >>> mm < 1
        True
    """

    mm: float  # of the middle of what the scanner saw
    mrad: float


@dataclass(frozen=True, eq=False)
class FittedHandEye(Value):
    """The hand-eye of a run: where the scanner sits on what carries it.

    As an array it is its pose.

    Example:
        >>> run.hand_eye
        FittedHandEye(T_flange_scanner at (...) mm, U at the part 0... mm and 0... mrad)
        >>> bool((np.asarray(run.hand_eye) == run.T_mount).all())
        True
    """

    pose: Array  # (4, 4) T_frame_scanner, length_unit
    covariance: Array  # (6, 6) of pose·exp(ξ), scanner frame, rotation first; rad and length_unit
    frame: str  # "base" (eye_to_hand) or "flange" (eye_in_hand)
    length_unit: str
    middle: Array  # (3,) of what the scanner saw, scanner frame, length_unit: where the part is
    unknown: tuple[str, ...] = ()  # of x, y, z, rx, ry, rz: what the views do not show

    @property
    def name(self) -> str:
        """T_base_scanner or T_flange_scanner."""
        return f"T_{self.frame}_scanner"

    @property
    def transform(self) -> Any:
        """The pose as scipy's RigidTransform, length_unit.

        Raises:
            InputError: scipy is older than 1.16.
        """
        return rigid_transform(self.pose)

    @property
    def U(self) -> AtPart:
        """U (k = 2) in mm and mrad at the part, for a complete model: over all directions, one number each."""
        mm = MILLIMETRES[self.length_unit]
        turn = COVERAGE_FACTOR * float(np.sqrt(np.trace(self.covariance[:3, :3])))
        return AtPart(displacement(self.covariance, self.middle) * mm, 1e3 * turn)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.pose, dtype=dtype)

    def __repr__(self) -> str:
        place = ", ".join(f"{x:.5g}" for x in self.pose[:3, 3])
        if self.unknown:
            return f"FittedHandEye({self.name}, {', '.join(self.unknown)} not known)"
        return (
            f"FittedHandEye({self.name} at ({place}) {self.length_unit}, "
            f"U at the part {self.U.mm:.2g} mm and {self.U.mrad:.2g} mrad)"
        )


def fitted_hand_eye(
    session: SessionData, capture: Capture, T_mount: Array, covariance: Array, *, unknown: tuple[str, ...]
) -> FittedHandEye:
    """Return a hand-eye with its covariance and the point at which its U is stated.

    The point is where the views of the capture see the part: the mean over the views of their centroids, scanner frame.

    Args:
        T_mount: (4, 4) T_base_scanner (eye_to_hand) or T_flange_scanner (eye_in_hand), length_unit.
        covariance: (6, 6) of T_mount·exp(ξ), scanner frame, rotation first; rad and length_unit.
        unknown: of x, y, z, rx, ry, rz: what the views do not show.
    """
    part_centre = np.mean([points.mean(axis=0) for points in capture.point_sets], axis=0)
    frame = "base" if session.mount == "eye_to_hand" else "flange"
    return FittedHandEye(T_mount, covariance, frame, session.length_unit, part_centre, unknown)


@dataclass(frozen=True, eq=False)
class Stitched(FusedCloud):
    """The stitched cloud in the reference frame: the flange (eye_to_hand) or the base (eye_in_hand).

    Example:
        >>> run.stitched
        Stitched(... points in the frame of the base, mm)
        >>> run.stitched.points.shape == run.stitched.normals.shape == (len(run.stitched), 3)
        True
    """

    frame: str  # "flange" or "base"
    length_unit: str

    @property
    def colours(self) -> Colours:
        """(N, 3) bytes, by residual from dark to yellow; grey where one view alone saw it."""
        return residual_colours(self.residual)[0]

    def to_open3d(self, tensor: bool = False) -> Any:
        """Return an Open3D PointCloud with normals and colours by residual; lengths in length_unit.

        Args:
            tensor: of Open3D's tensors, with `residual` and `count` (N, 1) beside.

        Raises:
            InputError: Open3D is not installed, or lacks a library of the system.

        Example:
            >>> cloud = run.stitched.to_open3d()
            >>> cloud.has_normals(), len(cloud.points) == len(run.stitched)
            (True, True)
        """
        o3d = import_open3d("to_open3d")
        if not tensor:
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(self.points, np.float64)))
            cloud.normals = o3d.utility.Vector3dVector(np.array(self.normals, np.float64))
            cloud.colors = o3d.utility.Vector3dVector(self.colours / 255)
            return cloud
        of_tensors = o3d.t.geometry.PointCloud(np.array(self.points, np.float64))
        columns = {"normals": self.normals, "colors": self.colours / 255}
        columns |= {"residual": self.residual[:, None], "count": self.count[:, None]}
        for name, values in columns.items():
            of_tensors.point[name] = np.array(values, np.float32)
        return of_tensors

    def to_trimesh(self) -> Any:
        """Return a trimesh.PointCloud with colours by residual; lengths in length_unit.

        Its metadata holds `normals` (N, 3), `residual` (N,) and `count` (N,).

        Example:
            >>> cloud = run.stitched.to_trimesh()
            >>> sorted(cloud.metadata)
            ['count', 'normals', 'residual']
        """
        import trimesh

        cloud = trimesh.PointCloud(np.array(self.points), colors=self.colours)
        cloud.metadata |= {"normals": self.normals, "residual": self.residual, "count": self.count}
        return cloud

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Stitched({len(self):,} points in the frame of the {self.frame}, {self.length_unit})"


@dataclass(frozen=True, eq=False)
class RunView(Value):
    """One view as the run puts it.

    Example:
        >>> view = run.views[0]
        >>> view.name, view.pose.shape, view.correction.shape
        ('v000', (4, 4), (6,))
    """

    name: str
    pose: Array  # (4, 4) T_reference_scanner after register, length_unit
    pose_model: Array  # (4, 4) of robot, hand-eye and effects alone
    correction: Array  # (6,) twist in the reference frame, pose = exp(correction)·pose_model; rad and length_unit
    rms: float  # of its distances from the others, length_unit
    points: int  # that were scanned, with labelled ones

    @property
    def transform(self) -> Any:
        """`pose` as scipy's RigidTransform.

        Raises:
            InputError: scipy is older than 1.16.
        """
        return rigid_transform(self.pose)


@dataclass(frozen=True, repr=False, eq=False)
class Run(RunData):
    """The results of one session; lengths in the session's length_unit, angles in rad.

    `print(run)` writes it as one block; in a notebook the last line of a cell shows the part as report.html does.

    Example:
        >>> run
        Run('s', 5 views, residual 0.0... mm, held-out 0.0... mm, Model(hand-eye at (...), no effects, 0 targets))
        >>> run.hand_eye.pose.shape, run.hand_eye.covariance.shape, run.hand_eye.frame
        ((4, 4), (6, 6), 'flange')
        >>> run.hand_eye.U.mm < 1 and run.hand_eye.U.mrad < 1
        True
        >>> run.stitched.points.shape[1], run.stitched.frame
        (3, 'base')
        >>> run.views[0].name, run.views[0].pose.shape
        ('v000', (4, 4))
        >>> tuple(run.residuals.column_names[:3])
        ('view', 'partner', 'x')
        >>> print(run)
        [[s]] 5 views, eye_in_hand, mm
        ...
    """

    # With the views that were left out; and calls of a recorder, replayed by `save`.
    measured: Session | None = field(default=None, compare=False)
    folder: Path | None = field(default=None, compare=False)  # that it was read from
    recorded: tuple[tuple[str, tuple[Any, ...]], ...] = field(default=(), compare=False)

    @property
    def hand_eye(self) -> FittedHandEye:
        """Where the scanner sits: pose (4, 4), covariance (6, 6), and U in mm and mrad at the part."""
        return fitted_hand_eye(
            self.session, self.measurement.capture, self.T_mount, self.mount_covariance, unknown=self.unknown
        )

    @property
    def stitched(self) -> Stitched:
        """The stitched cloud (N, 3) with normals and residuals, reference frame."""
        fused = self.fused
        return Stitched(
            fused.points,
            fused.normals,
            fused.residual,
            fused.count,
            frame=self.session.reference_frame,
            length_unit=self.session.length_unit,
        )

    @property
    def views(self) -> tuple[RunView, ...]:
        """The views that were fused, in the session's order; the others stand in `left_out`."""
        return tuple(
            RunView(
                name=view.name,
                pose=self.poses[v],
                pose_model=self.poses_model[v],
                correction=self.corrections[v],
                rms=float(self.view_rms[v]),
                points=points_of(view),
            )
            for v, view in enumerate(self.session.views)
        )

    @property
    def residuals(self) -> Any:
        """A pyarrow.Table as residuals.parquet has it: a row per residual, before register moves single views.

        Columns: view, partner, x, y, z, nx, ny, nz (reference frame), residual (length_unit), time_s, every covariate.
        """
        return residual_table(self)

    def save(
        self, folder: Path | str, *, force: bool = False, recording: bool = True, tolerance: float | None = None
    ) -> Path:
        """Write the run folder that `stitch run` writes of the same data, and return its path.

        A session that lies in no folder is written beside it, as FOLDER-session, so that every command works on the
        run. What a run wrote there before is replaced; other files stay.

        Args:
            force: replace the run of another session too, or one of this session with another history.
            recording: write recording.rrd.
            tolerance: within which the views have to agree on the part, length_unit: for the page's light.

        Raises:
            InputError: the folder is no place for this run, FOLDER-session holds another session, or an effect in use
                has no source that could be read again.

        Example:
            >>> saved = run.save(folder / "runs" / "bracket", recording=False)
            >>> tuple(sorted(path.name for path in saved.glob("*.json")))
            ('ledger.json', 'result.json')
        """
        folder = Path(folder)
        _require_own_history(self, folder, force)
        # What nobody could read again is refused before anything is written.
        effects_source(self)
        whole = self.measured or public_session(self.session)
        path = _save_session_of_run(whole, folder) if whole.in_memory else whole.path
        saved = replace(self, session=replace(self.session, path=path))
        with run_folder.new_folder(folder, [path], force) as scratch:
            run_folder.write_with_page(saved, scratch, tolerance, saved._tell if recording else None)
        return folder

    def _tell(self, recorder: Recorder) -> None:
        """Make all calls of the run on a recorder, to the last one."""
        for call, arguments in self.recorded:
            getattr(recorder, call)(*arguments)
        recorder.finish(self)

    def plot(self, of: Literal["part", "error"] = "part") -> Any:
        """Return a matplotlib Figure: the part at every step of the model, coloured by how far its views disagree.

        Of labelled points alone, how far each target lies off.

        Args:
            of: "error" shows how the error falls from step to step of the model, in place of the part.

        Raises:
            InputError: no package that draws is installed.

        Example:
            >>> type(run.plot()).__name__
            'Figure'
            >>> len(better.plot("error").axes) > 0
            True
        """
        draw = _entry_point("stitch.run_plots")
        if of not in ("part", "error"):
            raise InputError(f'run.plot: {of!r} is no picture; to fix: "part" or "error"')
        if draw is None:
            raise InputError("run.plot: nothing that draws is installed; to fix: install stitch with its package viz")
        return draw(self, of)

    def _repr_html_(self) -> str:
        """The viewer of report.html for a notebook; it asks no server. The report as text where nothing draws."""
        show = _entry_point("stitch.notebook_views")
        return f"<pre>{html.escape(str(self))}</pre>" if show is None else str(show(self))

    def __str__(self) -> str:
        return fit_report(self, self.hand_eye.U)


class ReplayRecorder(RecorderMemory):
    """Recorder that stores its calls, so that a recording can be written once the run is saved; it logs every stage.

    Args:
        other: recorder that gets every call at once; None: nobody does.
        progress: is called with the line of each stage.
    """

    def __init__(self, other: Recorder | None = None, progress: Callable[[str], object] | None = None) -> None:
        super().__init__()
        self.other = other or SilentRecorder()
        self.progress = progress

    def tell(self, call: str, *arguments: Any) -> None:
        """Store one call, a method's name and its arguments, and make it on the other recorder."""
        super().tell(call, *arguments)
        getattr(self.other, call)(*arguments)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Log one iteration and store the call."""
        _LOG.debug("%s, iteration %d: rms %.4g within %.4g", stage, index, rms, gate)
        super().iteration(stage, index, poses, rms, gate)

    def stage(self, result: StageResult, poses: Array) -> None:
        """Log a stage that has ended, pass its line to `progress`, and store the call."""
        line = f"{result.name}: rms {result.rms:.4g}, {result.seconds:.1f} s"
        _LOG.info("%s", line)
        if self.progress is not None:
            self.progress(line)
        super().stage(result, poses)

    def finish(self, run: RunData) -> None:
        """Pass on alone: `Run.save` finishes the recording."""
        self.other.finish(run)


def public_run(run: RunData, whole: Session | None, recorder: ReplayRecorder | None = None) -> Run:
    """Return a run as the public class `Run`, with the same values.

    Args:
        whole: its session with the views that were left out; None: as the run has it.
        recorder: the one that was told of the run, whose calls are stored for a recording; None: no recording.
    """
    values = {f.name: getattr(run, f.name) for f in fields(RunData)}
    calls = () if recorder is None else tuple(recorder.calls)
    return Run(**values | {"session": public_session(run.session)}, measured=whole, recorded=calls)


def rigid_transform(pose: Array) -> Any:
    """Return a pose (4, 4) as scipy's RigidTransform.

    Raises:
        InputError: scipy is older than 1.16.
    """
    kind = getattr(import_module("scipy.spatial.transform"), "RigidTransform", None)
    if kind is None:
        raise InputError("transform: scipy has no RigidTransform before 1.16; to fix: use pose, the matrix (4, 4)")
    return kind.from_matrix(pose)


def _require_own_history(run: RunData, folder: Path, force: bool) -> None:
    """Refuse to overwrite a run unless its ledger is the beginning of this run's ledger.

    The ledger is the list of the model's changes, with notes of people; overwriting another one would lose it.

    Args:
        force: overwrite in any case.

    Raises:
        InputError: the folder holds a run with another ledger.
    """
    if force or not (folder / "ledger.json").is_file():
        return
    steps = read_ledger(folder)
    own = json.loads(to_json(ledger(run)))
    if steps != own[: len(steps)]:
        raise InputError(
            f"{folder}: holds another run, whose model has a history of its own",
            fix_cli="name another folder with -o, or replace it with --force",
            fix_python="name another folder, or pass force=True",
        )


def _save_session_of_run(session: Session, folder: Path) -> Path:
    """Write the session as FOLDER-session and return its path; a session that lies there already stays.

    It is compared by writing this one again elsewhere: the same files give the same hash.

    Raises:
        InputError: another session lies there.
    """
    saved = folder.with_name(f"{folder.name}-session")
    if not (saved / "session.toml").is_file():
        return session.save(saved).path
    with TemporaryDirectory(dir=saved.parent, prefix=f".{saved.name}.") as scratch:
        again = session.save(Path(scratch) / saved.name).path
        same = content_hash(again, measured_files(again)) == content_hash(saved, measured_files(saved))
    if not same:
        raise InputError(
            f"{saved}: holds another session; to fix: save the run elsewhere, or run what session.save(FOLDER) returns"
        )
    return saved


def _entry_point(group: str) -> Callable[..., Any] | None:
    """Return what the first installed package offers under an entry-point group; None where none does."""
    return next((entry.load() for entry in entry_points(group=group)), None)

"""The Rerun recording of a run: every stage and iteration, on one timeline `step`."""

import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.runs.run import Run, StageResult
from stitch.units import MICROMETRES
from viz.blueprint import blueprint
from viz.colours import robust_limit, signed_colours, unsigned_colours, view_colours
from viz.history_figures import waterfall
from viz.page_parts import png_bytes
from viz.rrd_file import RecordingFile
from viz.run_figures import shown_points, view_shifts
from viz.run_markdown import run_markdown
from viz.target_figures import residual_vectors

os.environ.setdefault("RERUN_ANALYTICS", "off")
import rerun as rr

# What a screen can show; the run folder keeps everything.
_POINTS_PER_VIEW = 6_000
_POINTS_FUSED = 200_000


class RerunRecorder:
    """A `stitch.runs.recorder.Recorder` that writes one .rrd file.

    Every cloud is stored once, in its scanner's frame; iterations only move its transform.
    """

    def __init__(self, path: Path) -> None:
        self.file = RecordingFile("stitch", path, blueprint())
        self.recording = self.file.stream
        self.step = 0
        self.names: list[str] = []
        self.picked: list[Array] = []
        self.clouds: list[Array] = []
        self.to_um = 1e3

    def start(self, session: Session) -> None:
        """Log the scans and the robot's path."""
        self.to_um = MICROMETRES[session.length_unit]
        # A run that leaves views out begins again with the others.
        self.names, self.picked, self.clouds = [view.name for view in session.views], [], []
        rec = self.recording
        rec.log("scans", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        colours = view_colours(len(self.names))
        for view, colour in zip(session.views, colours, strict=True):
            points = shown_points(view)
            pick = np.linspace(0, len(points) - 1, min(len(points), _POINTS_PER_VIEW)).astype(int)
            self.picked.append(pick)
            self.clouds.append(points[pick].astype(np.float32))
            rec.log(f"scans/by_view/{view.name}", rr.Points3D(self.clouds[-1], colors=[colour]), static=True)
        flange = np.array([view.T_base_flange for view in session.views])
        rec.log("robot/flange_path", rr.LineStrips3D([flange[:, :3, 3]], colors=[(90, 90, 90)]), static=True)
        size = 0.05 * float(np.ptp(flange[:, :3, 3], axis=0).max() + 1e-9)
        for name, T in zip(self.names, flange, strict=True):
            rec.log(f"robot/{name}", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
            rec.log(f"robot/{name}", rr.TransformAxes3D(size), static=True)

    def iteration(self, stage: str, index: int, poses: Array, rms: float, gate: float) -> None:
        """Move the scans, add a point to the curves."""
        self._at_next_step()
        self._move(poses)
        self.recording.log(f"convergence/rms_um/{stage}", rr.Scalars(rms * self.to_um))
        self.recording.log(f"convergence/gate_um/{stage}", rr.Scalars(gate * self.to_um))

    def stage(self, result: StageResult, poses: Array, residuals: list[Array]) -> None:
        """Colour the scans by their distance from the other views, at the end of a stage."""
        self._at_next_step()
        self._move(poses)
        rec = self.recording
        limit = robust_limit(np.concatenate(residuals))
        for name, cloud, pick, residual in zip(self.names, self.clouds, self.picked, residuals, strict=True):
            colours = signed_colours(residual[pick], limit)
            rec.log(f"scans/by_residual/{name}", rr.Points3D(cloud, colors=colours))
        self._snapshot(result.name, poses, residuals, limit)
        text = f"{result.name}: {result.rms * self.to_um:.1f} µm rms, full colour at ±{limit * self.to_um:.0f} µm"
        rec.log("log", rr.TextLog(text))

    def finish(self, run: Run) -> None:
        """Log the fused cloud, the bars per view and the verdict, and close the file."""
        self._at_next_step()
        rec = self.recording
        fused = run.fused
        pick = np.linspace(0, len(fused.points) - 1, min(len(fused.points), _POINTS_FUSED)).astype(int)
        colours = unsigned_colours(fused.residual[pick], robust_limit(fused.residual))
        points = rr.Points3D(fused.points[pick].astype(np.float32), colors=colours)
        rec.log("fused", points, static=True)
        if run.targets is not None:
            self._sticks(run)
        rec.log("views/rms_um", rr.BarChart(np.nan_to_num(run.view_rms) * self.to_um), static=True)
        shift = np.linalg.norm(view_shifts(run), axis=1) * self.to_um
        rec.log("views/correction_um", rr.BarChart(shift), static=True)
        rec.log("verdict", rr.TextDocument(run_markdown(run), media_type=rr.MediaType.MARKDOWN), static=True)
        self._history(run)
        rec.send_blueprint(blueprint())
        self.file.write()

    def _sticks(self, run: Run) -> None:
        """Offsets of the targets under the model, magnified, beside the targets."""
        assert run.targets is not None
        target, left = residual_vectors(run)
        start = run.targets.landmarks.positions[target]
        longest = max(float(np.quantile(np.linalg.norm(left, axis=1), 0.99)), 1e-300)
        factor = 0.25 * (float(np.ptp(start, axis=0).max()) or 1.0) / longest
        strips = np.stack([start, start + factor * left], axis=1).astype(np.float32)
        self.recording.log("fused/sticks", rr.LineStrips3D(strips, colors=[(72, 120, 168)]), static=True)
        self.recording.log("log", rr.TextLog(f"sticks at the targets are {factor:.0f} times longer than they are"))

    def _history(self, run: Run) -> None:
        """The waterfall of the error, and the maps of the part before and after the last change."""
        pictures = {"waterfall": waterfall(run.ledger, run.session.length_unit)}
        for name, figure in pictures.items():
            self.recording.log(f"history/{name}", encoded(figure), static=True)

    def _snapshot(self, stage: str, poses: Array, residuals: list[Array], limit: float) -> None:
        """The whole set as it stood at the end of a stage, on a static entity for side-by-side views."""
        if stage not in ("correct", "register"):
            return
        placed = [cloud @ T[:3, :3].T + T[:3, 3] for cloud, T in zip(self.clouds, poses, strict=True)]
        values = np.concatenate([r[pick] for r, pick in zip(residuals, self.picked, strict=True)])
        name = "before" if stage == "correct" else "after"
        # One scale for both: that of the state before, or the change would not show.
        self.shared_limit = limit if stage == "correct" else getattr(self, "shared_limit", limit)
        points = rr.Points3D(np.concatenate(placed), colors=signed_colours(values, self.shared_limit))
        self.recording.log(f"{name}", points, static=True)

    def _move(self, poses: Array) -> None:
        for name, T in zip(self.names, poses, strict=True):
            placed = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
            for colouring in ("by_view", "by_residual"):
                self.recording.log(f"scans/{colouring}/{name}", placed)

    def _at_next_step(self) -> None:
        self.step += 1
        self.recording.set_time("step", sequence=self.step)


def encoded(figure: Figure) -> rr.EncodedImage:
    """A figure as a picture that stays small in the file."""
    return rr.EncodedImage(contents=png_bytes(figure, 140), media_type="image/png")

"""The Rerun recording of a run: its stages and iterations, the model's history, why, and the cell."""

import os
from pathlib import Path

import numpy as np
import rerun as rr

from stitch.numerics.units import MICROMETRES, length_text
from stitch.output.comparison.model_history import ModelHistory, effect_changes, model_history
from stitch.output.comparison.run_verdict import run_headline
from stitch.run_data import RunData
from viz.blueprint import log_colour_bar, model_blueprint, target_blueprint
from viz.colours import robust_limit, unsigned_colours
from viz.course_recording import log_no_course
from viz.diagnosis_recording import NOT_YET
from viz.iteration_timeline import Moments, keep_moments, kept_moments, log_moments, shown_moments
from viz.model_timeline import log_model, model_scene
from viz.part_surface import camera_for, part_surface
from viz.robot_scene import log_robot
from viz.rrd_file import RecordingFile, id_of, words
from viz.run_numbers import residual_vectors

# What a run found, as Markdown for the recording.


def run_markdown(run: RunData, history: ModelHistory | None) -> str:
    """Verdict, the error of each step, what could not be seen."""
    lines = [f"# {run.session.name}", "", f"**{run_headline(run, history)}**", ""]
    for doubt in run.doubts:
        lines += [doubt, ""]
    if run.effects:
        from stitch.output.plain_words import effect_in_words

        lines += [f"In the model: {', '.join(map(effect_in_words, run.effects))}.", ""]
    lines += [run.verdict, ""]
    if history is not None:
        lines += ["| step of the model | views disagree by |", "|---|---:|"]
        lines += [f"| {s.name} | {length_text(s.field.mean_abs, run.session.length_unit)} |" for s in history.steps]
        lines += [""]
    if len(run.ledger) > 1:
        lines += ["| model | rms in the fit | on views left out |", "|---|---:|---:|"]
        for i, step in enumerate(run.ledger):
            told = [length_text(rms, run.session.length_unit) for rms in (step.residual_rms, step.heldout_rms)]
            lines += [f"| {effect_changes(run.ledger, i)} | {' | '.join(told)} |"]
        lines += [""]
    lines += [f"- Registered by {stage.remark}." for stage in run.stages if stage.method]
    lines += [f"- Not observable from these motions: {direction}" for direction in run.unobservable]
    lines += [f"- {note}" for note in run.notes]
    return "\n".join(lines)


os.environ.setdefault("RERUN_ANALYTICS", "off")


class RerunRecorder(Moments):
    """A `stitch.recorder.Recorder` that keeps all moments of a run, and writes one .rrd file when it has ended.

    One that lies there is of the models before, and its iterations are shown too.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def finish(self, run: RunData) -> None:
        """Log the run and close the file."""
        file = RecordingFile("stitch", self.path, id_of(run.session.name))
        rec, um = file.stream, MICROMETRES[run.session.length_unit]
        history = model_history(run)
        rec.log("verdict", words(run_markdown(run, history)), static=True)
        for place in ("diagnosis/plain", "diagnosis/verdict"):
            rec.log(place, words(NOT_YET), static=True)
        log_no_course(rec, NOT_YET)
        cell = log_robot(rec, run)
        moments = self.with_models(run, history, kept_moments(self.path))
        keep_moments(rec, moments)
        whole = self.sessions[0] if self.sessions else run.session
        if history is None:
            log_moments(rec, run, moments, whole, None)
            _log_targets(rec, run)
            rec.send_blueprint(target_blueprint(cell))
        else:
            surface = part_surface(run.fused, history.patches)
            camera = camera_for(surface.vertices, surface.normals, upright=run.session.mount == "eye_in_hand")
            scene = model_scene(run, history, surface, cell)
            raw = log_moments(rec, run, moments, whole, scene)
            log_model(rec, run, scene, camera.up, shown_moments(moments, scene))
            full = scene.limit * um
            log_colour_bar(rec, "colours/field", ["0", f"{full / 2:.3g}", f"{full:.3g} µm"], "seen by one view only")
            rec.send_blueprint(model_blueprint(scene, camera, raw, len(moments)))
        file.write()


def _log_targets(rec: rr.RecordingStream, run: RunData) -> None:
    """Targets by the rms of their views, and their offsets under the model, magnified."""
    colours = unsigned_colours(run.fused.residual, robust_limit(run.fused.residual))
    rec.log("targets", rr.Points3D(run.fused.points.astype(np.float32), colors=colours), static=True)
    if run.targets is None:
        return
    target, left = residual_vectors(run)
    start = run.targets.landmarks.positions[target]
    longest = max(float(np.quantile(np.linalg.norm(left, axis=1), 0.99)), 1e-300)
    factor = 0.25 * (float(np.ptp(start, axis=0).max()) or 1.0) / longest
    strips = np.stack([start, start + factor * left], axis=1).astype(np.float32)
    rec.log("targets/sticks", rr.LineStrips3D(strips, colors=[(72, 120, 168)]), static=True)
    rec.log("now", words(f"Sticks at the targets are {factor:.0f} times longer than they are."), static=True)

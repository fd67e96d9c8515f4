"""Page and recording of a panel held by several robots: contact points, shape before and after, forces, residuals."""

from pathlib import Path

import numpy as np

from stitch import frames
from stitch.cells.panel import PanelJob, PanelResult, leg_sentence, shape_sentence
from stitch.comparison.run_verdict import ToleranceVerdict
from stitch.frames import Array
from viz.cells import stage
from viz.cells.page import Page, Picture, Table, write
from viz.cells.panel_error_figures import errors_figure
from viz.cells.panel_figures import deviation_before, expected_after, forces, misfit, shape
from viz.colours import signed_colours
from viz.identity import Row

# mm of arrow for a newton, and for a millimetre out of shape, beside a panel of three metres.
_PER_NEWTON, _PER_MM = 4.0, 60.0


def write_page(job: PanelJob, result: PanelResult, path: Path) -> None:
    """Sentence, shape, forces, errors along a motion, residuals of the robots; tables."""
    pictures = []
    if result.shape is not None:
        caption = (
            "The panel unrolled, seen from outside; triangles are the clamps' pads. Colour: how far a control point "
            "stands outside (red) or inside (blue) its target. Right: what the commanded motion of the clamps leaves "
            "if the panel follows them exactly; with three points a clamp that is next to nothing, and what a stiff "
            "panel really leaves the next measurement shows."
        )
        pictures.append(Picture("Shape before and after", shape(job, result), caption))
    if job.forces is not None:
        caption = "Change since the panel was laid on; along z of a clamp, and across it in the panel's plane."
        pictures.append(Picture("Forces at the clamps", forces(job), caption))
    caption = "Reflectors seen by the tracker against the fitted model, every bar one robot; 1 is the tracker's sigma."
    pictures.append(Picture("What the model of each robot leaves", misfit(job, result), caption))
    caption = "What the uncertainty of the model does to the slaves when the master moves."
    figure = errors_figure(job.robots, job.master, result.errors.shift, result.errors.turn)
    pictures.append(Picture("Errors to expect along a motion", figure, caption))
    words = (sentence(job, result), job.file, _about(job))
    tables, notes, light = _tables(job, result), _notes(result), _light(job, result)
    write(Page("Panel held by robots", *words, pictures, tables, notes=notes, light=light), path)


def _light(job: PanelJob, result: PanelResult) -> ToleranceVerdict | None:
    """Of the shape, against the job's tolerance."""
    if result.shape_largest is None:
        return None
    worst, beyond = float(result.shape_largest.max()), int((result.shape_largest > job.tolerance).sum())
    if not beyond:
        return ToleranceVerdict(
            "good", f"The shape is within {job.tolerance:g} mm at all clamps: {worst:.2f} mm at most."
        )
    return ToleranceVerdict(
        "bad",
        f"The shape is not within {job.tolerance:g} mm at {beyond} of {len(job.robots)} clamps: {worst:.2f} mm at "
        "most, before the commanded motion.",
    )


def _about(job: PanelJob) -> list[Row]:
    readings = sum(own.reflectors.shape[0] * own.reflectors.shape[1] for own in job.calibration)
    control = "" if job.control is None else f", {len(job.control.nominal)} control points of the panel"
    tracker, legs = job.tracker, "" if job.legs is None else " of six legs each"
    return [
        ("Measured", f"{readings:,} readings of reflectors on the robots{control}"),
        ("Arm", f"{len(job.robots)} robots{legs}: {', '.join(job.robots)}; master {job.robots[job.master]}"),
        ("Sensor", f"laser tracker, sigma {tracker.constant * 1e3:g} µm and {tracker.per_length * 1e6:g} µm a metre"),
    ]


def sentence(job: PanelJob, result: PanelResult) -> str:
    """Pose and shape in one."""
    parts = []
    if result.pose_error is not None:
        off, turn = np.linalg.norm(result.pose_error[3:]), np.degrees(np.linalg.norm(result.pose_error[:3]))
        parts.append(f"The panel stands {off:.2f} mm and {turn:.3f}° off its target.")
    if (shape := shape_sentence(job, result)) is not None:
        parts.append(shape)
    return " ".join(parts) or f"{len(job.robots)} robots and the tracker are joined in one model."


def _notes(result: PanelResult) -> list[str]:
    return [leg_sentence(o) for o in result.legs if o.detected]


def _tables(job: PanelJob, result: PanelResult) -> list[Table]:
    rows = []
    for model in result.models:
        sigma = np.sqrt(np.diag(model.covariance)).reshape(4, 3).max(axis=1)
        base = " ".join(f"{x:.2f}" for x in model.T_world_base[:3, 3])
        degrees = np.degrees(sigma)
        base_sigma, clamp_sigma = ((f"{sigma[k]:.3f}", f"{degrees[k - 1]:.4f}") for k in (1, 3))
        rows.append((model.name, base, *base_sigma, *clamp_sigma, f"{model.p_value:.2g}"))
    header = ("robot", "base in the world (mm)", "σ (mm)", "σ (°)", "clamp σ (mm)", "σ (°)", "misfit p")
    return [Table("Global model", header, rows)]


def record(job: PanelJob, result: PanelResult, path: Path) -> None:
    """World frame: tracker, robots with flanges and clamps, the panel's control points by deviation, forces."""
    words = "\n\n".join(["# Panel", sentence(job, result), *_notes(result), _LEGEND])
    to_world = job.T_world_target
    with stage.stage(path, "Panel", words) as recording:
        stage.frame(recording, "tracker", frames.make(np.eye(3), job.tracker.position), 300.0)
        stage.frame(recording, "panel", to_world, 300.0)
        stands = result.preposition if job.flanges is None else job.flanges
        for i, (model, T) in enumerate(zip(result.models, stands, strict=True)):
            T_world_flange = model.T_world_base @ T
            stage.frame(recording, f"robots/base {model.name}", model.T_world_base, 250.0)
            stage.frame(recording, f"robots/flange {model.name}", T_world_flange, 120.0)
            _record_legs(recording, job, model.name, model.T_world_base, T_world_flange)
            pads = frames.transform(to_world, result.contacts.pads[i])
            stage.line(recording, f"clamps/{model.name}", pads[[0, 1, 2, 0]], stage.GREY, 6.0)
            if job.forces is not None:
                R = (T_world_flange @ model.T_flange_contact)[:3, :3]
                force = (R @ job.forces[i, 3:])[None] * _PER_NEWTON
                stage.arrows(recording, f"forces/{model.name}", pads.mean(axis=0)[None], force, stage.BLUE, 8.0)
        if result.shape is not None and job.control is not None:
            _record_shape(recording, job, result)


_LEGEND = (
    "Bases with their legs, flanges, clamps as triangles. Control points: red outside, blue inside the target; arrows "
    f"show how far, {_PER_MM:g} times larger, once as measured and once as expected after the correction. Blue arrows "
    f"at the clamps: forces, {_PER_NEWTON:g} mm a newton."
)


def _record_legs(recording: stage.Recording, job: PanelJob, name: str, T_base: Array, T_flange: Array) -> None:
    if job.legs is None:
        return
    feet, ends = frames.transform(T_base, job.legs.base), frames.transform(T_flange, job.legs.platform)
    for name_of, ring in (("foot", feet), ("platform", ends)):
        stage.line(recording, f"robots/{name_of} {name}", np.vstack([ring, ring[:1]]), stage.BLUE, 12.0)
    for k in range(6):
        stage.line(recording, f"robots/legs {name}/{k + 1}", np.array([feet[k], ends[k]]), stage.GREY, 10.0)


def _record_shape(recording: stage.Recording, job: PanelJob, result: PanelResult) -> None:
    assert job.control is not None
    places = frames.transform(job.T_world_target, job.control.nominal)
    outward = -(job.T_world_target @ result.contacts.T_panel_contact[job.control.clamp])[:, :3, 2]
    before = deviation_before(job, result)
    limit = float(np.abs(before).max())
    for name, values in (("before", before), ("after", expected_after(job, result))):
        stage.points(recording, f"shape/{name}", places, signed_colours(values, limit), 25.0)
        arrows = outward * values[:, None] * _PER_MM
        colour = stage.RED if name == "before" else stage.GREEN
        stage.arrows(recording, f"shape/{name}/error", places, arrows, colour, 8.0)

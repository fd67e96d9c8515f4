"""What a drilling job found, in sentences: the same on the terminal, on the page and in the recording."""

from collections.abc import Iterator

import numpy as np

from stitch.cells.drilling.camera_effects import Trial
from stitch.cells.drilling.drill_solution import JobResult
from stitch.cells.drilling.tool_axis import ToolAxis
from stitch.units import known_text

_NOT_FOUND = {"plate_height": "No error of the plate's height", "k1": "No distortion of the lens"}


def worth(result: JobResult, length_unit: str) -> str:
    """What the correction is worth."""
    before = np.concatenate([np.linalg.norm(c.errors, axis=1) for c in result.groups.values()])
    after = np.concatenate([np.linalg.norm(c.residuals, axis=1) for c in result.groups.values()])
    return (
        f"{len(result.drives)} holes to drill in {len(result.groups)} groups. By the drawing the drives miss the "
        f"reference holes by {before.min():.2f} to {before.max():.2f} {length_unit}; after the correction "
        f"{after.max():.2f} {length_unit} at most is left."
    )


def hand_eye(result: JobResult, length_unit: str) -> Iterator[str]:
    """What camera and plate are worth; nothing where four holes leave none to test with."""
    if len(result.leave_one_out_errors):
        sizes = np.linalg.norm(result.leave_one_out_errors, axis=1)
        yield (
            "Hand-eye: each hole of the plate mapped by the others is off by "
            f"{sizes.mean():.3f} {length_unit} on average, {sizes.max():.3f} {length_unit} at most."
        )


def found_effects(result: JobResult, length_unit: str) -> Iterator[str]:
    """Effects of camera and tool that are taken out."""
    for trial in result.effects.trials if result.effects else ():
        if trial.accepted:
            yield f"{_camera(trial, length_unit)} (1 σ; p = {trial.p_value:.1g}). That is taken out."
    if result.tool_axis is not None and result.tool_axis.accepted:
        yield f"The tool's true axis lies {_tilt(result.tool_axis)} off its frame's z (1 σ); the drives take it up."


def effects_not_found(result: JobResult) -> Iterator[str]:
    """Effects of camera and tool that were looked for in vain."""
    for trial in result.effects.trials if result.effects else ():
        if not trial.accepted:
            yield f"{_NOT_FOUND[trial.effect]} beyond chance (p = {trial.p_value:.1g})."
    if (tool := result.tool_axis) is not None and not tool.accepted:
        yield f"No tilt of the tool's axis beyond chance ({_tilt(tool)}, 1 σ; p = {tool.p_value:.1g})."


def _camera(found: Trial, length_unit: str) -> str:
    """What an effect of the camera is, and its size."""
    if found.effect == "plate_height":
        return f"The plate of holes is {known_text(found.value, found.sigma)} {length_unit} off its stated height"
    size = known_text(100 * found.value, 100 * found.sigma)
    return f"The lens shifts the image's corners by {size} % of their way from its middle"


def _tilt(tool: ToolAxis) -> str:
    return f"{np.degrees(tool.tilt):.2f} ± {np.degrees(tool.sigma):.2f}°"

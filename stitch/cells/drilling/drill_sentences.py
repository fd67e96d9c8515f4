"""What a drilling job found, in sentences: the same on the terminal, on the page and in the recording."""

from collections.abc import Iterator

import numpy as np

from stitch.cells.drilling.camera_effects import CameraEffectTest
from stitch.cells.drilling.drill_solution import DrillResult
from stitch.cells.drilling.tool_axis import ToolAxis
from stitch.units import value_uncertainty_text

_ABSENT_EFFECTS = {"plate_height": "No error of the plate's height", "k1": "No distortion of the lens"}


def correction_sentence(result: DrillResult, length_unit: str) -> str:
    """What the correction is worth."""
    before = np.concatenate([np.linalg.norm(c.errors, axis=1) for c in result.groups.values()])
    after = np.concatenate([np.linalg.norm(c.residuals, axis=1) for c in result.groups.values()])
    return (
        f"{len(result.drives)} holes to drill in {len(result.groups)} groups. By the drawing the drives miss the "
        f"reference holes by {before.min():.2f} to {before.max():.2f} {length_unit}; after the correction "
        f"{after.max():.2f} {length_unit} at most is left."
    )


def hand_eye_sentences(result: DrillResult, length_unit: str) -> Iterator[str]:
    """What camera and plate are worth; nothing where four holes leave none to test with."""
    if len(result.leave_one_out_errors):
        sizes = np.linalg.norm(result.leave_one_out_errors, axis=1)
        yield (
            "Hand-eye: each hole of the plate mapped by the others is off by "
            f"{sizes.mean():.3f} {length_unit} on average, {sizes.max():.3f} {length_unit} at most."
        )


def significant_effect_sentences(result: DrillResult, length_unit: str) -> Iterator[str]:
    """Effects of camera and tool that are taken out."""
    for trial in result.effects.trials if result.effects else ():
        if trial.accepted:
            yield f"{_camera_effect_sentence(trial, length_unit)} (1 σ; p = {trial.p_value:.1g}). That is taken out."
    if result.tool_axis is not None and result.tool_axis.accepted:
        yield f"The tool's true axis lies {_tool_tilt_sentence(result.tool_axis)} off its frame's z (1 σ); the drives take it up."


def absent_effect_sentences(result: DrillResult) -> Iterator[str]:
    """Effects of camera and tool that were looked for in vain."""
    for trial in result.effects.trials if result.effects else ():
        if not trial.accepted:
            yield f"{_ABSENT_EFFECTS[trial.effect]} beyond chance (p = {trial.p_value:.1g})."
    if (tool := result.tool_axis) is not None and not tool.accepted:
        yield f"No tilt of the tool's axis beyond chance ({_tool_tilt_sentence(tool)}, 1 σ; p = {tool.p_value:.1g})."


def _camera_effect_sentence(effect_test: CameraEffectTest, length_unit: str) -> str:
    """What an effect of the camera is, and its size."""
    if effect_test.effect == "plate_height":
        return f"The plate of holes is {value_uncertainty_text(effect_test.value, effect_test.sigma)} {length_unit} off its stated height"
    size = value_uncertainty_text(100 * effect_test.value, 100 * effect_test.sigma)
    return f"The lens shifts the image's corners by {size} % of their way from its middle"


def _tool_tilt_sentence(tool: ToolAxis) -> str:
    return f"{np.degrees(tool.tilt):.2f} ± {np.degrees(tool.sigma):.2f}°"

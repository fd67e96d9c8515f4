"""The arm of another run: its effects on joints and links as they are, under another mount, tool or day."""

from dataclasses import replace

from stitch.effects.in_session import find_effect
from stitch.errors import InputError
from stitch.model.model_toml import ModelFile

ARM_PLACES = ("robot", "links")  # where the effects of an arm stand in the chain


def keep_arm_effects(file: ModelFile) -> ModelFile:
    """The model with nothing but the effects of its arm, all of them kept.

    Raises:
        InputError: an effect that is not known, or none of the arm.
    """
    found = arm_model(file)
    if found is None:
        used = ", ".join(file.effects) or "none"
        raise InputError(
            f"--arm: the model has no effect of joints or links (its effects: {used}); to fix: name the run of a "
            "session that showed them, after `stitch add`"
        )
    return found


def arm_model(file: ModelFile) -> ModelFile | None:
    """The same; None without an effect of the arm.

    Raises:
        InputError: an effect that is not known.
    """
    effects = {
        name: {key: replace(p, kept=True) for key, p in own.items()}
        for name, own in file.effects.items()
        if find_effect(name).place in ARM_PLACES
    }
    return replace(file, effects=effects, targets={}) if effects else None

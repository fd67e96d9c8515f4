"""The model of a run folder, and the Python file of effects that it names: run only where somebody allows it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.effects.user_file import load
from stitch.errors import InputError
from stitch.model.model_toml import ModelFile, read_model
from stitch.stored.run_documents import covariance_of_effects


def trusted_model(path: Path, effects_file: Path | None = None, trust: bool = False) -> tuple[ModelFile, str | None]:
    """The model, and the absolute path of the file whose effects have joined the library, if any.

    Args:
        path: run folder, or model.toml.
        effects_file: the user's own file; takes the place of the one that the model names.
        trust: run the file that the model names.

    Raises:
        InputError: no model, a value in it that is no number, or a file of effects that nobody has allowed.
    """
    model = replace(read_model(path), effects_covariance=covariance_of_effects(path))
    file = path / "model.toml" if path.is_dir() else path
    for effect, fitted in model.effects.items():
        for name, parameter in fitted.items():
            if not np.isfinite(parameter.value):
                raise InputError(f"{file}: effects.{effect}.{name} is {parameter.value}; to fix: write a finite number")
    if effects_file is not None:
        load(effects_file)
        return model, str(effects_file.resolve())
    if model.effects_file and not trust:
        raise InputError(
            f"{file}: names effects in {model.effects_file}, Python that would be run with your rights; look at it, "
            "then allow it with --trust, or name a file of your own with --effects-file"
        )
    if model.effects_file:
        load(Path(model.effects_file))
    return model, model.effects_file

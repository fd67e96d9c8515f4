"""The hand-eye of a run folder for other programs: frames by name, numbers with U, what no format can hold."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.model.hand_eye_uncertainty import COVERAGE_FACTOR, numbers_covariance, uncertainty_scope
from stitch.model.model_toml import ModelFile, read_model
from stitch.stored.run_documents import read_diagnosis, read_result
from stitch.units import METRES, length_text

_PARENTS = {"eye_to_hand": "base_link", "eye_in_hand": "flange"}
_PARENT_WORDS = {"eye_to_hand": "base", "eye_in_hand": "flange"}
# Characters that a frame's name may have in every format: those of a link in URDF and of a name in YAML.
_PLAIN_LETTERS = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_")


@dataclass(frozen=True)
class ExportedHandEye:
    """A hand-eye with the names that other programs need."""

    session: str
    T_mount: Array  # (4, 4) T_parent_child, m
    covariance: Array  # (6, 6) of T·exp(ξ), scanner frame, rotation first; rad and m
    length_unit: str  # of the session
    mount: str  # eye_to_hand | eye_in_hand
    parent: str  # frame that carries the scanner, as other programs call it
    child: str  # the scanner's own frame
    notes: tuple[str, ...]  # plain sentences: what was not observable, what the numbers do not hold

    @property
    def name(self) -> str:
        """T_base_scanner or T_flange_scanner."""
        return f"T_{_PARENT_WORDS[self.mount]}_scanner"

    def head(self, numbers: Callable[[Array], Array], labels: Sequence[str], units: Sequence[str]) -> list[str]:
        """Lines for comments: what it is, U (k = 2) of each number that the format states, and the notes.

        Args:
            numbers: what the format writes of T_parent_child in m, (n,).
            labels: their names, (n,).
            units: their units, (n,).
        """
        sigma = np.sqrt(np.diag(numbers_covariance(numbers, self.T_mount, self.covariance)))
        sizes = zip(labels, COVERAGE_FACTOR * sigma, units, strict=True)
        U = [f"{label} {size:.2g} {unit}".rstrip() for label, size, unit in sizes]
        return [
            f"{self.name} of session {self.session}: maps coordinates of {self.child} into {self.parent}; "
            f"stitch {version('stitch')}",
            f"U (k = 2), in the frame {self.parent}: {', '.join(U)}",
            *self.notes,
        ]

    def lengths(self, unit: str) -> Array:
        """(4, 4) T_parent_child with lengths in "mm" or "m"."""
        T = self.T_mount.copy()
        T[:3, 3] /= METRES[unit]
        return T


def hand_eye_of_run(folder: Path, parent: str | None = None, child: str = "scanner") -> ExportedHandEye:
    """The corrected hand-eye of a run folder.

    Args:
        parent: name of the frame that carries the scanner; default base_link (eye_to_hand) or flange (eye_in_hand).

    Raises:
        InputError: no run, a damaged one, or a name that a frame cannot have.
    """
    result, model, told = read_result(folder), read_model(folder), read_diagnosis(folder)
    if model.mount not in _PARENTS:
        raise InputError(f"{folder}/model.toml: mount is {model.mount!r}; to fix: eye_to_hand or eye_in_hand")
    return hand_eye_from(result, model, told, parent, child)


def hand_eye_from(
    result: dict[str, Any], model: ModelFile, told: dict[str, Any], parent: str | None = None, child: str = "scanner"
) -> ExportedHandEye:
    """Return the corrected hand-eye of a result and its model.

    Args:
        result: as result.json.
        told: as diagnosis.json; {} where there is none.
        parent, child: names of frames, as `hand_eye_of` takes them.

    Raises:
        InputError: a name that a frame cannot have.
    """
    metres = METRES[model.length_unit]
    T, scale = model.T_mount.copy(), np.repeat([1.0, metres], 3)
    T[:3, 3] *= metres
    return ExportedHandEye(
        session=str(result.get("name") or Path(result["session"]).name),
        T_mount=T,
        covariance=model.covariance * np.outer(scale, scale),
        length_unit=model.length_unit,
        mount=model.mount,
        parent=_require_plain_name("--parent", parent or _PARENTS[model.mount]),
        child=_require_plain_name("--child", child),
        notes=(
            uncertainty_scope(told.get("verdict")).rstrip("."),
            *_undetectable_notes(told.get("candidates", []), model.length_unit),
            *_unobservable_notes(result["unobservable"]),
            *_omitted_effect_notes(model),
        ),
    )


def _require_plain_name(flag: str, name: str) -> str:
    if not name or not set(name) <= _PLAIN_LETTERS or name[0].isdigit():
        raise InputError(f"{flag} {name!r}: to fix: a name of letters, digits and _, as links in URDF have it")
    return name


def _unobservable_notes(directions: Sequence[str]) -> list[str]:
    return [f"Not observable from these motions, left at the coarse value: {direction}" for direction in directions]


def _undetectable_notes(candidates: Sequence[dict[str, Any]], length_unit: str) -> list[str]:
    """How far an effect that the views do not show could push the hand-eye: U is that of the model."""
    known = [(c["hand_eye_if_missed"], c["effect"]) for c in candidates if c.get("hand_eye_if_missed") is not None]
    if not known:
        return []
    size, name = max(known)
    pushed = length_text(size, length_unit, 2)
    return [f"Not in U: an effect too small to be seen could displace it, at the part, by as much as {pushed} ({name})"]


def _omitted_effect_notes(model: ModelFile) -> list[str]:
    """Effects of the model that one rigid hand-eye does not hold."""
    return [f"Not in these numbers, as they are one rigid motion: {', '.join(model.effects)}"] if model.effects else []

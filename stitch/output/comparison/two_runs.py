"""Two runs side by side: whether they can be compared, how far their hand-eyes differ, and one sentence."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch.errors import InputError
from stitch.model.model import COVERAGE_FACTOR
from stitch.numerics import frames
from stitch.numerics.distributions import chi2_tail
from stitch.numerics.frames import Array
from stitch.numerics.units import length_text
from stitch.output.comparison.model_history import ModelHistory, model_history
from stitch.run_data import RunData
from stitch.session.reading.session_folder import UNKNOWN, session_hash

# Probability below which chance does not explain a difference (5 %, as k = 2 covers 95 %).
_CHANCE = 0.05
# So many points at most give the distance between the places where two hand-eyes put the part.
_POINTS = 20_000


@dataclass(frozen=True)
class ComparedRun:
    """One of two runs, with what is asked of it more than once."""

    name: str  # of its folder
    run: RunData

    @property
    def history(self) -> ModelHistory | None:
        """The history of its model; None without clouds."""
        return model_history(self.run)

    @cached_property
    def data(self) -> str:
        """Hash of its session."""
        return session_hash(self.run.session)

    @property
    def error(self) -> float:
        """Return how far the views disagree under the model: mean on the part, or rms of labelled points."""
        return self.run.residual_rms if self.history is None else self.history.models[-1].field.mean_abs


class HandEyeChange:
    """From the hand-eye of A to that of B, to first order in their errors: T_A⁻¹·T_B = exp(twist), scanner frame of A.

    `twist` (6,) is rotation in rad, then translation in length_unit; `covariance` (6, 6) that of both, as if they erred
    independently. `at_part` is the rms distance between the places where both put the points of a view, `U_at_part`
    what their uncertainties alone make of it (k = 2).
    """

    def __init__(self, a: RunData, b: RunData) -> None:
        """Compare the hand-eye of run b with that of run a, at the points that b shows."""
        same = np.array_equal(a.T_mount, b.T_mount)  # else rounding would make a difference of it
        D = np.eye(4) if same else frames.inverse(a.T_mount) @ b.T_mount
        # exp(−ξ_A)·D·exp(ξ_B) = exp(Ad_D·ξ_B − ξ_A)·D for small ξ.
        carried = frames.adjoint(D)
        points = np.vstack(b.measurement.capture.point_sets)
        points = points[:: max(1, len(points) // _POINTS)]
        lever = np.concatenate([-frames.skew(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
        moments = np.einsum("nij,nik->jk", lever, lever) / len(points)
        displacements = frames.transform(D, points) - points
        self.twist = frames.log(D)
        self.covariance = a.mount_covariance + carried @ b.mount_covariance @ carried.T
        self.at_part = float(np.sqrt((displacements**2).sum(axis=1).mean()))
        self.U_at_part = COVERAGE_FACTOR * float(np.sqrt(np.sum(moments * self.covariance)))

    @property
    def U(self) -> Array:
        """(6,) expanded uncertainty (k = 2) of the twist."""
        return COVERAGE_FACTOR * np.sqrt(np.diag(self.covariance))

    @property
    def p_value(self) -> float:
        """Return the p-value of so large a twist under the stated uncertainties; NaN where none is stated."""
        if not np.isfinite(self.covariance).all():
            return float("nan")
        rank = np.linalg.matrix_rank(self.covariance)
        if rank == 0:
            return float("nan")
        return chi2_tail(float(self.twist @ np.linalg.pinv(self.covariance) @ self.twist), float(rank))


@dataclass(frozen=True)
class TwoRuns:
    """A and B, whose numbers count in the same unit and frames."""

    a: ComparedRun
    b: ComparedRun

    @property
    def same_data(self) -> bool:
        """The sessions hold the same files."""
        return self.a.data == self.b.data != UNKNOWN

    @cached_property
    def hand_eye(self) -> HandEyeChange:
        """Return how far the hand-eyes differ."""
        return HandEyeChange(self.a.run, self.b.run)


def compare_runs(runs: Sequence[RunData], names: Sequence[str]) -> TwoRuns:
    """Return two runs with the names of their folders.

    Raises:
        InputError: their numbers mean different things: unit, mount, or surfaces against labelled points.
    """
    a = ComparedRun(names[0], runs[0])
    b = ComparedRun(names[1], runs[1])
    for what, asked in (
        ("length_unit", lambda run: run.session.length_unit),
        ("mount", lambda run: run.session.mount),
        ("what the views show", lambda run: "labelled points alone" if run.registered is None else "surfaces"),
    ):
        of_a, of_b = asked(a.run), asked(b.run)
        if of_a != of_b:
            raise InputError(
                f"{a.name} and {b.name} cannot be compared: {what} is {of_a} in the one and {of_b} in the other; "
                "to fix: name two runs of one cell"
            )
    return TwoRuns(a, b)


def comparison_sentence(both: TwoRuns) -> str:
    """Return what changed from run A to run B in plain sentences: effects, disagreement of the views, hand-eye."""
    unit = both.a.run.session.length_unit
    error_a, error_b = (length_text(side.error, unit) for side in (both.a, both.b))
    labelled = both.a.history is None
    where = "rms over the labelled points" if labelled else "on average over the part"
    change = f"as far as those of A, by {error_a}" if error_a == error_b else f"by {error_b} instead of {error_a}"
    subject = _effects_difference(both.a.run.effects, both.b.run.effects)
    data = "" if both.same_data else ", on other data"
    hand_eyes = _hand_eye_sentence(both.hand_eye, unit, "targets" if labelled else "part")
    return f"{subject}{data}, the views of B disagree {change}, {where}. {hand_eyes}."


def _effects_difference(a: Sequence[str], b: Sequence[str]) -> str:
    """Return how the effects of model b differ from those of a: "With backlash and without latency in the model".

    Args:
        a, b: names of the effects.
    """
    gained = [effect for effect in b if effect not in a]
    lost = [effect for effect in a if effect not in b]
    parts = [f"{word} {' and '.join(names)}" for word, names in (("with", gained), ("without", lost)) if names]
    difference = " and ".join(parts) or "with the same effects"
    return f"{difference[0].upper()}{difference[1:]} in the model"


def _hand_eye_sentence(change: HandEyeChange, length_unit: str, what: str) -> str:
    """Return a sentence, without its full stop, on how far two hand-eyes displace the part, and if chance explains it.

    Args:
        what: "part" or "targets".
    """
    if not change.twist.any():
        return "Both have the same hand-eye"
    distance = f"The hand-eyes put the {what} {length_text(change.at_part, length_unit)} apart"
    if np.isnan(change.p_value):
        return f"{distance}; their uncertainty is not stated"
    beyond = "more than" if change.p_value < _CHANCE else "no more than"
    return f"{distance}, {beyond} their uncertainties explain"

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
from stitch.output.comparison.disagreement_field import ModelHistory, model_history
from stitch.run_data import RunData
from stitch.session.reading.session_folder import UNKNOWN, session_hash

# Probability below which chance does not explain a difference (5 %, as k = 2 covers 95 %).
_CHANCE = 0.05
# Points that say how far two hand-eyes put the part apart.
_POINTS = 20_000


@dataclass(frozen=True)
class ComparedRun:
    """One of two runs, with what is asked of it more than once."""

    name: str  # of its folder
    run: RunData
    history: ModelHistory | None  # None without clouds
    data: str  # hash of its session

    @property
    def error(self) -> float:
        """Return how far the views disagree under the model: mean on the part, or rms of labelled points."""
        return self.run.residual_rms if self.history is None else self.history.models[-1].field.mean_abs


@dataclass(frozen=True)
class HandEyeChange:
    """From the hand-eye of A to that of B, as twist (6,): T_A⁻¹·T_B = exp(twist), scanner frame of A."""

    twist: Array  # (6,) rotation in rad, translation in length_unit
    covariance: Array  # (6, 6) of both, as if they erred independently
    at_part: float  # rms distance between the places where both put the points of a view
    U_at_part: float  # what their uncertainties alone make of it, k = 2

    @property
    def U(self) -> Array:
        """(6,) expanded uncertainty (k = 2) of the twist."""
        return COVERAGE_FACTOR * np.sqrt(np.diag(self.covariance))

    @property
    def p_value(self) -> float:
        """Return the p-value of so large a twist under the stated uncertainties; NaN where none is stated."""
        if not np.isfinite(self.covariance).all() or not (rank := np.linalg.matrix_rank(self.covariance)):
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
        return hand_eye_change(self.a.run, self.b.run)


def compare_runs(runs: Sequence[RunData], names: Sequence[str]) -> TwoRuns:
    """Return two runs with the names of their folders.

    Raises:
        InputError: their numbers mean different things: unit, mount, or surfaces against labelled points.
    """
    a, b = runs
    for what, of_a, of_b in (
        ("length_unit", a.session.length_unit, b.session.length_unit),
        ("mount", a.session.mount, b.session.mount),
        ("what the views show", _seen_points(a), _seen_points(b)),
    ):
        if of_a != of_b:
            raise InputError(
                f"{names[0]} and {names[1]} cannot be compared: {what} is {of_a} in the one and {of_b} in the other; "
                "to fix: name two runs of one cell"
            )
    sides = [
        ComparedRun(name, run, model_history(run), session_hash(run.session))
        for name, run in zip(names, runs, strict=True)
    ]
    return TwoRuns(*sides)


def _seen_points(run: RunData) -> str:
    return "labelled points alone" if run.registered is None else "surfaces"


def hand_eye_change(a: RunData, b: RunData) -> HandEyeChange:
    """Return the difference of two hand-eyes with what is known of both, to first order in their errors."""
    same = np.array_equal(a.T_mount, b.T_mount)  # else rounding would make a difference of it
    D = np.eye(4) if same else frames.inverse(a.T_mount) @ b.T_mount
    # exp(−ξ_A)·D·exp(ξ_B) = exp(Ad_D·ξ_B − ξ_A)·D for small ξ.
    carried = frames.adjoint(D)
    covariance = a.mount_covariance + carried @ b.mount_covariance @ carried.T
    points = np.vstack(b.measurement.capture.point_sets)
    points = points[:: max(1, len(points) // _POINTS)]
    lever = np.concatenate([-frames.skew(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
    moments = np.einsum("nij,nik->jk", lever, lever) / len(points)
    apart = frames.transform(D, points) - points
    return HandEyeChange(
        twist=frames.log(D),
        covariance=covariance,
        at_part=float(np.sqrt((apart**2).sum(axis=1).mean())),
        U_at_part=COVERAGE_FACTOR * float(np.sqrt(np.sum(moments * covariance))),
    )


def comparison_sentence(both: TwoRuns) -> str:
    """Return what changed from A to B, for everybody."""
    unit = both.a.run.session.length_unit
    off_a, off_b = (length_text(side.error, unit) for side in (both.a, both.b))
    where = "rms over the labelled points" if both.a.history is None else "on average over the part"
    told = f"as far as those of A, by {off_a}" if off_a == off_b else f"by {off_b} instead of {off_a}"
    subject = _effects_difference(both.a.run.effects, both.b.run.effects) + (
        "" if both.same_data else ", on other data"
    )
    seen = "targets" if both.a.history is None else "part"
    return f"{subject}, the views of B disagree {told}, {where}. {_hand_eye_sentence(both.hand_eye, unit, seen)}."


def _effects_difference(a: Sequence[str], b: Sequence[str]) -> str:
    """Return: With joint_compliance and without backlash in the model."""
    gained, lost = [e for e in b if e not in a], [e for e in a if e not in b]
    parts = [f"with {' and '.join(gained)}"] * bool(gained) + [f"without {' and '.join(lost)}"] * bool(lost)
    told = " and ".join(parts) or "with the same effects"
    return f"{told[0].upper()}{told[1:]} in the model"


def _hand_eye_sentence(change: HandEyeChange, length_unit: str, seen: str) -> str:
    if not change.twist.any():
        return "Both have the same hand-eye"
    apart = f"The hand-eyes put the {seen} {length_text(change.at_part, length_unit)} apart"
    if np.isnan(change.p_value):
        return f"{apart}; their uncertainty is not stated"
    beyond = "more than" if change.p_value < _CHANCE else "no more than"
    return f"{apart}, {beyond} their uncertainties explain"

"""What some views would tell: the hand-eye's U, what could be detected and named, what could not be told apart."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.diagnosis.sensitivity.detectable import detectable_sizes
from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import usual_sizes
from stitch.planning.chances import Chance, ExpectedDiagnosis, usual_shifts
from stitch.planning.expected_hand_eye import ExpectedHandEye, expected_hand_eye
from stitch.planning.expected_model import CellModel, expected_model, simulate_views
from stitch.planning.rivals import EffectPair, effect_pairs
from stitch.planning.scatter import FittedScatter, Scatter
from stitch.planning.told_sizes import expected_scatter, with_scatter


@dataclass(frozen=True)
class EffectOutlook:
    """One effect that could be missing."""

    name: str
    observable: bool
    detectable: dict[str, float]  # smallest size of every parameter that is detected in 80 % of cases
    usual: dict[str, float]  # plausible sizes
    units: dict[str, str]
    chance: Chance | None  # at usual size; None where the views cannot show it, or where it was not asked for

    @property
    def multiple(self) -> float:
        """Of its usual size from which the parameter that shows best is detected; infinite where none does."""
        return min((self.detectable[name] / self.usual[name] for name in self.detectable), default=float("inf"))


@dataclass(frozen=True)
class Outlook:
    """What V views would tell."""

    views: int
    hand_eye: ExpectedHandEye
    ordinary: ExpectedHandEye  # with an arm that is a little wrong in every joint and link
    effects: tuple[EffectOutlook, ...]  # likeliest to be detected first
    pairs: tuple[EffectPair, ...]  # of the effects that the views show, hardest first
    untestable: dict[str, tuple[str, ...]]  # effect: what it needs and the session has not
    fitted_scatter: FittedScatter  # errors that the views leave open


def view_outlook(
    session: Session,
    cell: CellModel,
    fitted_scatter: FittedScatter | None = None,
    feature: Array | None = None,
    chances: bool = True,
) -> Outlook:
    """What the views of a session would tell.

    Args:
        fitted_scatter: errors of the arm; None: as large as these views leave them open where it errs by its scatter alone.
        feature: (3,) reference frame: the place whose displacement U counts; None: the middle of the field.
        chances: draw what a diagnosis would say of every effect.

    Raises:
        NoResultError: a view that would not see the part, or views that do not overlap.
    """
    found = simulate_views(session, cell)
    linear = expected_model(found, cell)
    fitted_scatter = expected_scatter(linear, cell.scatter.noise) if fitted_scatter is None else fitted_scatter
    diagnosed = with_scatter(linear, fitted_scatter.fitted)
    candidates, missing = candidates_of(linear, empirical=False)
    expected = ExpectedDiagnosis(diagnosed, candidates)
    at = None if feature is None else feature_in_scanner(found.unconstrained.poses, feature)
    ordinary = _ordinary_scatter(fitted_scatter.believed)
    return Outlook(
        views=len(session.views),
        hand_eye=expected_hand_eye(with_scatter(linear, fitted_scatter.believed), found, at),
        ordinary=expected_hand_eye(with_scatter(linear, ordinary), found, at),
        effects=_effect_outlooks(diagnosed, candidates, expected, chances),
        pairs=tuple(effect_pairs(diagnosed, expected.candidates)),
        untestable={name: needs for name, needs in missing.items() if name not in linear.model.effects},
        fitted_scatter=fitted_scatter,
    )


def _ordinary_scatter(scatter: Scatter) -> Scatter:
    """With errors as large as those of a usual arm, where they are not larger anyway."""
    usual = usual_sizes()
    return replace(scatter, errors=scatter.errors | {k: max(v, scatter.errors.get(k, 0.0)) for k, v in usual.items()})


def feature_in_scanner(poses: Array, feature: Array) -> Array:
    """(3,) mean place of a point of the reference frame in the scanner's frame."""
    return np.asarray(np.einsum("vji,vj->vi", poses[:, :3, :3], feature - poses[:, :3, 3]).mean(axis=0))


def _effect_outlooks(
    linear: LinearModel, candidates: Sequence[Candidate], expected: ExpectedDiagnosis, chances: bool
) -> tuple[EffectOutlook, ...]:
    shown, rng, out = {c.name for c in expected.candidates}, np.random.default_rng(0), []
    for c in candidates:
        sizes = detectable_sizes(linear, c, expected.tests)
        believable = {p.name: sizes[p.name] for p in c.parameters if p.name in sizes and sizes[p.name] < p.limit}
        chance = expected.chance(c.name, usual_shifts(c, rng), rng) if chances and c.name in shown else None
        own = [p for p in c.parameters if not p.grid]
        usual, units = {p.name: p.typical for p in own}, {p.name: p.unit for p in own}
        out.append(EffectOutlook(c.name, c.name in shown, believable, usual=usual, units=units, chance=chance))
    return tuple(sorted(out, key=lambda e: (not e.observable, e.multiple)))

"""Labelled points beside clouds: gross errors out, and where the targets lie under the model that both fitted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.effects.chain import Chain
from stitch.effects.undo import corrected
from stitch.labelled.fit import LabelledFit, rms_of
from stitch.labelled.fitted_landmarks import fitted_landmarks, landmarks_covariance
from stitch.labelled.gross import Outlier, gross
from stitch.labelled.robust import taken_out
from stitch.labelled.rows import rows_of
from stitch.stages.correct import Correction


@dataclass(frozen=True)
class Beside:
    """One session of a rig whose clouds and labelled points were fitted together."""

    chain: Chain  # with the sightings that count, and what the clouds weigh beside them
    found: LabelledFit | None  # None without labelled points
    outliers: tuple[Outlier, ...]


def fitted_beside(
    chains: Sequence[Chain], fit: Callable[[Sequence[Chain]], Correction]
) -> tuple[Correction, list[Beside]]:
    """Fit, take out the labelled points that contradict the rest, and again, until none does.

    Raises:
        NoResultError: more than a third of the labelled points of a session would have to go.
    """
    chains = [_with_everything(chain) for chain in chains]
    taken = [list[Outlier]() for _ in chains]
    while True:
        correction = fit(chains)
        found = [placed_targets(chain, correction) for chain in chains]
        worse = [gross(f.rows, f.variances) if f else [] for f in found]
        if not any(worse):
            chains = [weighed(chain, own.noise_factor) for chain, own in zip(chains, correction.captures, strict=True)]
            return correction, [Beside(c, f, tuple(o)) for c, f, o in zip(chains, found, taken, strict=True)]
        chains = [taken_out(chain, w) if w else chain for chain, w in zip(chains, worse, strict=True)]
        taken = [[*before, *w] for before, w in zip(taken, worse, strict=True)]


def placed_targets(chain: Chain, correction: Correction) -> LabelledFit | None:
    """Targets in the middle of where the views put them under a fitted model; None without labelled points.

    Their covariance counts the scatter of the poses, the sensor's noise and the hand-eye.
    """
    if chain.capture.sightings is None:
        return None
    hand_eye = correction.hand_eye
    own = corrected(chain, correction.terms, hand_eye.T_mount)
    landmarks, blocks, variances = fitted_landmarks(own, hand_eye.T_mount)
    rows = rows_of(own, hand_eye.T_mount, landmarks)
    covariance = landmarks_covariance(blocks, rows, hand_eye.covariance)
    distances = rows.distances(rows.left)
    return LabelledFit(
        hand_eye.T_mount, hand_eye.covariance, hand_eye.inflation, landmarks, covariance, correction.terms,
        correction.sigmas, variances, rows, np.full(distances.shape, np.nan), (rms_of(distances),),
    )  # fmt: skip


def _with_everything(chain: Chain) -> Chain:
    s = chain.capture.sightings
    return chain if s is None else replace(chain, capture=replace(chain.capture, sightings=s.everything))


def weighed(chain: Chain, noise_factor: float) -> Chain:
    """The chain with clouds that weigh as they were found to (`Capture.noise_factor`)."""
    return replace(chain, capture=replace(chain.capture, noise_factor=noise_factor))

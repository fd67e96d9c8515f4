"""Fit hand-eye, landmarks and the effects in use to labelled points: Gauss–Newton with REML of the scatter."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from stitch.frames import Array, exp
from stitch.measurement.measurement import Measurement, Term
from stitch.model.forward import corrected
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import Rows, effect_rows, evidence_of_rows, rows_of
from stitch.stages.joint_fit import CHOOSING, WEAK, fitted_parameters, with_values
from stitch.statistics.block_least_squares import Blocks, whitener
from stitch.statistics.folds import grouped_folds, places
from stitch.statistics.variance_components import fit_variances

_MAXIMUM_ITERATIONS = 12
# Settled when no unknown moves by this share of its sigma.
_CONVERGED = 0.02


@dataclass(frozen=True)
class LabelledFit:
    """What the labelled points of one session say; twists are right perturbations T·exp(ξ), rotation first."""

    T_mount: Array  # (4, 4)
    covariance: Array  # (6, 6)
    inflation: float
    landmarks: Landmarks
    landmarks_covariance: Array  # (U, U)
    terms: tuple[Term, ...]
    sigmas: tuple[Array, ...]  # per term (P,); NaN where the views cannot see a parameter
    variances: Array  # (3,) of rotation scatter, translation scatter, factor on the sensor's noise
    rows: Rows  # at the solution
    heldout: Array  # (V, S) distances of targets predicted without their own views; NaN where none was seen
    history: tuple[float, ...]  # 3D rms per iteration

    @property
    def rms(self) -> float:
        """3D root mean square over all targets of all views."""
        return rms_of(self.rows.distances(self.rows.residual))

    @property
    def heldout_rms(self) -> float:
        """The same for targets predicted without their own views."""
        return rms_of(self.heldout)

    @property
    def noise_floor(self) -> float:
        """What the sensor's own noise would leave of it if every pose were perfect."""
        noise = self.rows.noise[: len(self.rows.lever), : self.rows.positions]
        return float(np.sqrt(3 * np.mean(noise[noise > 0])))

    @property
    def target_rms(self) -> Array:
        """(K,) rms distance of the views from every target; NaN for one that nobody sees."""
        s, distances = self.rows.capture.sightings, self.rows.distances(self.rows.residual)
        assert s is not None
        return np.array([rms_of(distances[s.used & (s.target == k)]) if n else np.nan for k, n in enumerate(s.seen)])


def rms_of(distances: Array) -> float:
    """Root mean square, NaN left out."""
    return float(np.sqrt(np.nanmean(distances**2)))


def fit(measurement: Measurement, terms: Sequence[Term], T_mount: Array, landmarks: Landmarks) -> LabelledFit:
    """Hand-eye, landmarks and effects together, from a start that is near.

    Args:
        measurement: with the sightings that count.
        terms: effects in use with the values to begin with.
    """
    terms, history = list(terms), []
    parameters = [p for term in terms for p in measurement.parameters(term.effect)]
    sizes, held = np.array([p.typical for p in parameters]), np.array([bool(p.grid) for p in parameters], bool)
    seen: Array = np.zeros(len(parameters), bool)
    start: Array | None = None
    for index in range(_MAXIMUM_ITERATIONS):
        own = corrected(measurement, terms, T_mount)
        rows = rows_of(own, T_mount, landmarks)
        history.append(rms_of(rows.distances(rows.residual)))
        columns = np.concatenate(
            [np.zeros((*rows.residual.shape, 0)), *(effect_rows(rows, measurement, terms, t) for t in terms)], axis=2
        )
        values = np.concatenate([np.zeros(0), *(t.values for t in terms)])
        base = np.concatenate([rows.hand_eye, rows.landmarks], axis=2)
        if index < CHOOSING:
            whiten = partial(_whitened, rows, base, columns, values, start)
            seen = fitted_parameters(measurement, terms, seen, sizes, whiten)
        X = np.concatenate([base, columns[..., seen]], axis=2)
        variances = start = _variances(rows, X, start)
        blocks = _blocks(rows, X, sizes[seen], values[seen], variances)
        x, covariance = blocks.solve(), blocks.estimates_covariance()
        a = base.shape[2]
        T_mount, landmarks = T_mount @ exp(x[:6]), landmarks.moved(x[6:a])
        # What the views cannot see stays at zero; the time of an event stays where it was found.
        values[np.logical_not(held | seen)] = 0.0
        values[seen] += x[a:]
        terms = with_values(terms, values)
        if np.max(np.abs(x) / np.sqrt(np.maximum(np.diag(covariance), 1e-300))) < _CONVERGED:
            break
    inflation = blocks.inflation(places(rows.capture.T_reference_mount, rows.reach), covariance)
    covariance = covariance * inflation
    sigmas = np.full(len(values), np.nan)
    sigmas[seen] = np.sqrt(np.diag(covariance)[a:])
    cuts = np.cumsum([len(t.values) for t in terms], dtype=int)
    final = rows_of(corrected(measurement, terms, T_mount), T_mount, landmarks)
    return LabelledFit(
        T_mount, covariance[:6, :6], inflation, landmarks, covariance[6:a, 6:a], tuple(terms),
        tuple(np.split(sigmas, cuts)[: len(terms)]), variances, final, _heldout(rows, blocks),
        (*history, rms_of(final.distances(final.residual))),
    )  # fmt: skip


def _variances(rows: Rows, A: Array, start: Array | None) -> Array:
    """(3,) by REML with the columns A (B, m, a) as free mean."""
    return fit_variances(evidence_of_rows(rows, A), start=start, both_starts=start is None).variances


def _whitened(
    rows: Rows, base: Array, columns: Array, values: Array, start: Array | None, free: Array
) -> tuple[Array, Array, Array]:
    """In units of the scatter: columns of hand-eye and landmarks (N, a), of effects (N, P), and z (N,) without these.

    Args:
        values: (P,) of the effects at which the rows were taken.
        free: (P,) bool: effects that explain scatter.
    """
    evidence = evidence_of_rows(rows, base)
    half = whitener(evidence, _variances(rows, np.concatenate([base, columns[..., free]], axis=2), start))
    z = evidence.z + columns @ values
    own, further, seen = ((half @ c).reshape(rows.residual.size, c.shape[2]) for c in (base, columns, z[..., None]))
    return own, further, seen[:, 0]


def _blocks(rows: Rows, X: Array, sizes: Array, values: Array, variances: Array) -> Blocks:
    """The step's normal equations; the prior of the effects is about zero, not about their present values."""
    evidence = evidence_of_rows(rows, X)
    distance = float(np.median(np.linalg.norm(np.concatenate(rows.capture.point_sets), axis=1)))
    unknown = X.shape[2] - len(sizes)
    # One radian and one working distance: keeps the unseen finite, moves nothing else.
    far = np.concatenate([[1.0] * 3, [distance] * (unknown - 3)])
    precision = np.concatenate([far, WEAK * sizes]) ** -2.0
    pull = np.concatenate([np.zeros(unknown), -values * precision[unknown:]])
    return Blocks(evidence.z, X, evidence.covariance(variances), precision, pull)


def _heldout(rows: Rows, blocks: Blocks) -> Array:
    """(V, S) distances of targets whose views were left out with their neighbours in time or pose."""
    square, count = np.zeros((2, *rows.distances(rows.residual).shape))
    for fold in grouped_folds(rows.capture.T_reference_mount, rows.reach):
        left = rows.residual + blocks.X @ blocks.solve(fold)
        square[fold] += rows.distances(left)[fold] ** 2
        count[fold] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(square / count))

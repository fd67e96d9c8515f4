"""Fit the hand-eye and the effects in use together: match anew, free the views, generalised least squares, repeat."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stitch.effects.groups import one_by_one
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement, Term
from stitch.model.forward import corrected
from stitch.observations.surfaces.free_poses import FreePoses, free_poses
from stitch.observations.surfaces.hand_eye import Columns, HandEye, fit_hand_eye
from stitch.observations.surfaces.match import sample
from stitch.observations.surfaces.overlaps import FINE_SAMPLES, Overlaps, collect, next_gate
from stitch.observations.surfaces.point_effects import all_columns
from stitch.observations.surfaces.scanner_field import field_scatters
from stitch.stages.correct import Correction
from stitch.statistics.identifiability import independent, whitened
from stitch.statistics.parameter_selection import omitted_rms, supported

_MAXIMUM_ITERATIONS = 6
# Settled when no parameter moves by a twentieth of its sigma.
_CONVERGED = 0.05
# Iterations in which it is still open what is fitted.
CHOOSING = 2
# A parameter that these views know worse than this many times its plausible size stays at zero: it would
# only borrow from the hand-eye.
UNSEEN = 4.0
WEAK = 10.0


@dataclass(frozen=True)
class Refinement:
    """Hand-eye and effects; per chain what follows from them."""

    hand_eye: HandEye
    terms: tuple[Term, ...]
    sigmas: tuple[Array, ...]  # per term (P,); NaN where the views cannot see a parameter
    captures: tuple[Capture, ...]  # without the effects
    freed: tuple[FreePoses, ...]
    overlaps: tuple[Overlaps, ...]
    history: tuple[float, ...]

    def as_correction(self) -> Correction:
        """As the stage `correct` returns it."""
        poses = tuple(f.poses for f in self.freed)
        return Correction(self.hand_eye, self.overlaps, poses, self.history, self.captures, self.terms, self.sigmas)


def refine(
    measurements: Sequence[Measurement], terms: Sequence[Term], T_mount: Array, gate: Sequence[float]
) -> Refinement:
    """All sessions of a rig share hand-eye and effects.

    Args:
        terms: effects in use with the values to begin with.
        T_mount: (4, 4) hand-eye to begin with.
        gate: per chain the first distance between partners, length_unit.

    Raises:
        NoResultError: no two views overlap.
    """
    terms, history = list(terms), []
    parameters = [p for term in terms for p in measurements[0].parameters(term.effect)]
    sizes = np.array([p.typical for p in parameters])
    held = np.array([bool(p.grid) for p in parameters], bool)
    seen = np.zeros(len(parameters), bool)
    for iteration in range(_MAXIMUM_ITERATIONS):
        captures, freed = _free(measurements, terms, T_mount, gate)
        columns = [np.hstack([np.zeros((6 * len(c.scans), 0)), *all_columns(measurement, terms, terms, T_mount, f)[0]])
                   for measurement, c, f in zip(measurements, captures, freed, strict=True)]  # fmt: skip
        values = np.concatenate([np.zeros(0), *(t.values for t in terms)])
        if iteration < CHOOSING:
            # What the scanner repeats hardly changes with the last micrometres.
            repeating = field_scatters(measurements, freed)
            whiten = partial(whitened, captures, freed, T_mount, columns, values)
            seen = fitted_parameters(measurements[0], terms, seen, sizes, whiten)
            unfitted = np.where(held, 0.0, omitted_rms(*whiten(seen), sizes, seen))
        fitted = fit_hand_eye(
            captures,
            freed,
            T_mount,
            Columns(tuple(c[:, seen] for c in columns), values[seen], WEAK * sizes[seen]),
            # A parameter at zero that is not zero errs alike in every view, as the scanner does.
            [np.hstack([r, c * unfitted]) for r, c in zip(repeating, columns, strict=True)],
        )
        T_mount, before = fitted.T_mount, values.copy()
        # What the views cannot see stays at zero; the time of an event stays where it was found.
        values[~held] = 0.0
        values[seen] = fitted.values
        terms = with_values(terms, values)
        history.append(float(np.median([f.overlaps.gram.rms for f in freed])))
        sigma = np.sqrt(np.maximum(np.diag(fitted.values_covariance), 1e-300))
        if not len(values) or np.max(np.abs(values - before)[seen] / sigma, initial=0.0) < _CONVERGED:
            break
    captures, freed = _free(measurements, terms, T_mount, [f.overlaps.gate for f in freed])
    overlaps = tuple(_settled_overlaps(c, T_mount, gate) for c, gate in zip(captures, gate, strict=True))
    sigmas = np.full(len(seen), np.nan)
    sigmas[seen] = np.sqrt(np.diag(fitted.values_covariance))
    cuts = np.cumsum([len(t.values) for t in terms], dtype=int)
    own = tuple(np.split(sigmas, cuts)[: len(terms)])
    return Refinement(fitted, tuple(terms), own, captures, tuple(freed), overlaps, tuple(history))


def fitted_parameters(
    measurement: Measurement,
    terms: Sequence[Term],
    before: Array,
    sizes: Array,
    whiten: Callable[[Array], tuple[Array, ...]],
) -> Array:
    """(P,) bool: parameters that the views support and can tell apart.

    Args:
        before: (P,) bool: what explained scatter so far.
        sizes: (P,) plausible sizes.
        whiten: from what explains scatter to whitened columns of the hand-eye (and landmarks), of the effects, and z.
    """
    groups, effects, at = list[list[int]](), list[int](), 0
    for number, term in enumerate(terms):
        own = one_by_one(term.effect, measurement.parameters(term.effect))
        groups += [[at + i for i in group] for group in own]
        effects += [number] * len(own)
        at += len(term.values)
    if not groups:
        return before
    free = before
    for _ in range(CHOOSING):
        # What is found explains scatter, and less scatter shows more.
        own_columns, further, z = whiten(free)
        free = supported(own_columns, further, z, sizes, groups, effects)
    own_columns, further, _ = whiten(free)
    return np.logical_and(free, independent(own_columns, further * free, sizes, 1 / UNSEEN))


def _free(
    measurements: Sequence[Measurement], terms: Sequence[Term], T_mount: Array, gates: Sequence[float]
) -> tuple[tuple[Capture, ...], list[FreePoses]]:
    captures = tuple(corrected(measurement, terms, T_mount) for measurement in measurements)
    return captures, [free_poses(c, c.poses(T_mount), gate) for c, gate in zip(captures, gates, strict=True)]


def _settled_overlaps(capture: Capture, T_mount: Array, gate: float) -> Overlaps:
    """Correspondences of the model's own poses; the gate follows what they leave."""
    samples = [sample(scan, FINE_SAMPLES) for scan in capture.scans]
    overlaps = collect(capture, capture.poses(T_mount), gate, samples)
    return collect(capture, capture.poses(T_mount), min(gate, next_gate(overlaps, capture)), samples)


def with_values(terms: Sequence[Term], values: Array) -> list[Term]:
    """The terms with the values of all their parameters in one row."""
    out, at = [], 0
    for term in terms:
        out.append(replace(term, values=values[at : at + len(term.values)]))
        at += len(term.values)
    return out

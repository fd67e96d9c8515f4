"""The model of a cell in memory: hand-eye with covariance, effects in use, places of targets.

The covariance Σ of a hand-eye belongs to a right perturbation T·exp(ξ) in the scanner frame. Rotation vector and
translation of T in the mount frame move by J·ξ with J = diag(J_r⁻¹, R), so that theirs is J·Σ·Jᵀ, to first order
(`printed_covariance`). The parameters of all effects in use have a covariance of their own (`EffectsCovariance`):
errors of one go with errors of another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.effects.axis_effects import PLACEMENT, SCANNER_PLACEMENT
from stitch.effects.contract import Effect, Parameter, find_effect, parameters_in
from stitch.numerics import frames
from stitch.numerics.distributions import sigmas_among
from stitch.numerics.frames import Array, Mask
from stitch.numerics.units import MILLIMETRES, value_uncertainty_text
from stitch.session.measurement import Measurement
from stitch.system.values import Value

ARM_PLACES = ("base", "robot", "links")  # where the effects of an arm stand in the chain of frames
# Expanded uncertainty U = k·σ, coverage about 95 % (JCGM 100:2008, GUM).
COVERAGE_FACTOR = 2.0
# A person may edit the sigmas of model.toml; then the matrix of the fit is no longer theirs.
_SAME_SIGMA = 1e-6


@dataclass(frozen=True, eq=False)
class Term(Value):
    """An effect in use; P parameters in the order of the effect's arguments.

    Example:
        >>> term = better.terms[0]
        >>> term.name, term.values.shape
        ('range_scale', (1,))
    """

    effect: Effect
    parameters: tuple[Parameter, ...]

    @property
    def name(self) -> str:
        """That of the effect."""
        return self.effect.name

    @property
    def is_geometry(self) -> bool:
        """True if it says where something stands, not what goes wrong: every model that can have it has it."""
        return self.effect.tier == "geometry"

    @property
    def sigmas_from_zero(self) -> float:
        """The largest |value|/sigma of its fitted parameters, corrected for their number (Bonferroni); 0 of none."""
        sigmas = [abs(p.value) / p.sigma for p in self.parameters if p.fitted and not p.grid]
        return sigmas_among(max(sigmas), len(sigmas)) if sigmas else 0.0

    @property
    def values(self) -> Array:
        """(P,) in each parameter's unit."""
        return values_of([self])

    @property
    def sigmas(self) -> Array:
        """(P,) standard deviations; NaN where a parameter is held."""
        return np.array([p.sigma for p in self.parameters], float)

    @property
    def typical(self) -> Array:
        """(P,) plausible sizes, each in its parameter's unit."""
        return sizes_of([self])

    @property
    def gridded(self) -> Mask:
        """(P,) mask of the parameters that are tried value by value instead of fitted."""
        return np.array([bool(p.grid) for p in self.parameters], bool)

    @cached_property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of the effect's function, with these values."""
        return self.effect.arguments(self.parameters)

    def at(self, values: Array, sigmas: Array | None = None) -> "Term":
        """Return the term with other values (P,), and other sigmas (P,); None: these stay.

        Example:
            >>> better.terms[0].at(np.zeros(1)).values
            array([0.])
        """
        pairs = zip(self.parameters, values, strict=True)
        parameters = [p if p.value == value else replace(p, value=float(value)) for p, value in pairs]
        if sigmas is not None:
            parameters = [replace(p, sigma=float(sigma)) for p, sigma in zip(parameters, sigmas, strict=True)]
        return Term(self.effect, tuple(parameters))


@dataclass(frozen=True)
class EffectsCovariance:
    """Covariance of K fitted parameters, each in its own unit."""

    names: tuple[str, ...] = ()  # effect.parameter
    matrix: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (K, K)
    # With axes: (6, 6 + K) of T·exp(ξ) with itself, as far as the motions show it, and with the parameters; else empty.
    with_hand_eye: Array = field(default_factory=lambda: np.zeros((6, 0)))

    def root(self, terms: Sequence[Term]) -> Array:
        """Return L (P, K) with L·Lᵀ the covariance of all P parameters of some terms.

        Rows of parameters that were not fitted are zero. A parameter whose sigma differs from that of the matrix, as
        one that a person edited in model.toml, counts with its own sigma and without correlation.
        """
        parameters = [(f"{term.name}.{p.name}", p) for term in terms for p in term.parameters]
        index = {name: k for k, name in enumerate(self.names)}
        sigma = np.sqrt(np.diag(self.matrix))
        # Number of each parameter whose sigma is that of the matrix, and its index there.
        correlated = {
            i: index[name]
            for i, (name, p) in enumerate(parameters)
            if name in index and p.fitted and abs(p.sigma - sigma[index[name]]) <= _SAME_SIGMA * sigma[index[name]]
        }
        uncorrelated = [i for i, (_, p) in enumerate(parameters) if p.fitted and i not in correlated]
        L = np.zeros((len(parameters), len(correlated) + len(uncorrelated)))
        if correlated:
            columns = list(correlated.values())
            unit = sigma[columns]
            values, vectors = np.linalg.eigh(self.matrix[np.ix_(columns, columns)] / np.outer(unit, unit))
            L[list(correlated), : len(correlated)] = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        for column, i in enumerate(uncorrelated, len(correlated)):
            L[i, column] = parameters[i][1].sigma
        return L


@dataclass(frozen=True)
class Target:
    """A labelled point in the reference frame, or a probe with its orientation."""

    position: Array  # (3,) length_unit
    sigma: Array  # (3,)
    orientation: Array | None = None  # (3, 3) R_reference_probe


@dataclass(frozen=True, eq=False)
class Model(Value):
    """Fitted parameters of a cell: hand-eye, effects, targets. Lengths in the session's length_unit, angles in rad.

    Example:
        >>> run.model.T_mount.shape, run.model.covariance.shape, run.model.effects
        ((4, 4), (6, 6), [])
    """

    T_mount: Array  # (4, 4) T_base_scanner or T_flange_scanner
    terms: tuple[Term, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))  # of T·exp(ξ), scanner frame, rotation first
    targets: dict[str, Target] = field(default_factory=dict)
    effects_covariance: EffectsCovariance = field(default_factory=EffectsCovariance)

    @property
    def effects(self) -> list[str]:
        """Names of the effects in use."""
        return [term.name for term in self.terms if not term.is_geometry]

    def with_terms(self, terms: Sequence[Term]) -> "Model":
        """Return the model with other effects in use.

        Example:
            >>> better.effects, better.model.with_terms(()).effects
            (['range_scale'], [])
        """
        return replace(self, terms=tuple(terms))

    def without(self, name: str) -> "Model":
        """Return the model without one effect.

        Example:
            >>> better.model.without("range_scale").effects
            []
        """
        return self.with_terms([term for term in self.terms if term.name != name])

    def with_term(self, term: Term) -> "Model":
        """Return the model with a term added as the last one; its term of the same effect, if any, is dropped.

        Example:
            >>> run.model.with_term(better.model.terms[0]).effects
            ['range_scale']
        """
        return self.with_terms([*self.without(term.name).terms, term])

    def covariance_with(self, names: Sequence[str]) -> Array:
        """Return the covariance (6 + P, 6 + P) of the hand-eye's twist, T_mount·exp(ξ), and of P parameters.

        Rows of parameters that were not fitted are zero.

        Args:
            names: effect.parameter of each of the P parameters.

        Example:
            >>> run.model.covariance_with([]).shape
            (6, 6)
        """
        known = self.effects_covariance
        covariance = np.zeros((6 + len(names), 6 + len(names)))
        covariance[:6, :6] = self.covariance
        fitted = [i for i, name in enumerate(names) if name in known.names]
        rows = 6 + np.array(fitted, int)
        index = np.array([known.names.index(names[i]) for i in fitted], int)
        covariance[np.ix_(rows, rows)] = known.matrix[np.ix_(index, index)]
        if known.with_hand_eye.size:
            covariance[:6, rows] = known.with_hand_eye[:, 6 + index]
            covariance[rows, :6] = covariance[:6, rows].T
        return covariance

    def __repr__(self) -> str:
        effects = ", ".join(self.effects) or "no effects"
        position = ", ".join(f"{x:.4g}" for x in self.T_mount[:3, 3])
        return f"Model(hand-eye at ({position}), {effects}, {len(self.targets)} targets)"


def geometry_terms(measurement: Measurement) -> tuple[Term, ...]:
    """Return the terms of tier geometry that every model of a session fits with the hand-eye, at value 0.

    They place external axes and further scanners; () without any. Axes that are used as given are not fitted.
    """
    axes = measurement.views.axes
    scanners = (term_of(measurement, find_effect(SCANNER_PLACEMENT)),) if measurement.views.scanners else ()
    if not axes:
        return scanners
    term = term_of(measurement, find_effect(PLACEMENT))
    still = {axis.name for k, axis in enumerate(axes.axes) if axis.is_fixed or k == axes.frame_axis}
    # The frame axis is placed by the hand-eye. `kept` parameters are never fitted.
    parameters = [replace(p, kept=p.name.partition("_")[2] in still) for p in term.parameters]
    return (Term(term.effect, tuple(parameters)), *scanners)


def term_of(measurement: Measurement, effect: Effect) -> Term:
    """Return an effect as a term at value 0; parameters that are tried value by value in the middle of their grid."""
    zero = Term(effect, parameters_in(measurement, effect))
    return zero.at(np.array([p.grid[len(p.grid) // 2] if p.grid else 0.0 for p in zero.parameters]))


def grid_terms(measurement: Measurement, effect: Effect) -> list[Term]:
    """Return an effect as terms at value 0, one for every combination of the values that are tried (`grid`)."""
    zero = Term(effect, parameters_in(measurement, effect))
    return [zero.at(np.array(values)) for values in product(*(p.grid or (0.0,) for p in zero.parameters))]


def stack_parameters(terms: Sequence[Term]) -> tuple[Parameter, ...]:
    """Return all parameters of all terms, term after term."""
    return tuple(p for term in terms for p in term.parameters)


def values_of(terms: Sequence[Term]) -> Array:
    """Return (P,) values of all parameters of all terms, each in its unit."""
    return np.array([p.value for p in stack_parameters(terms)], float)


def sizes_of(terms: Sequence[Term]) -> Array:
    """Return (P,) plausible sizes of all parameters of all terms, each in its unit."""
    return np.array([p.typical for p in stack_parameters(terms)], float)


def with_parameter_values(terms: Sequence[Term], values: Array) -> tuple[Term, ...]:
    """Return the terms with other values (P,) of all their parameters, in the order of `stack_parameters`."""
    return tuple(map(Term.at, terms, np.split(values, np.cumsum([len(term.parameters) for term in terms])[:-1])))


def kept_root(terms: Sequence[Term], covariance: EffectsCovariance) -> Array:
    """Return L (P, K) with L·Lᵀ the covariance of the parameters kept from another run; rows of all others are zero."""
    kept = np.array([p.kept for term in terms for p in term.parameters], bool)
    root = covariance.root(terms) * kept[:, None]
    return root[:, (root != 0).any(axis=0)]


def with_fitted_effects(model: Model, fitted: Mask, of_fitted: Array, kept_root: Array, with_hand_eye: Array) -> Model:
    """Return a model after a fit: with sigmas and covariance of the parameters fitted and of those of another run.

    Sigmas of all other parameters are NaN, and the covariance does not have them.

    Args:
        fitted: (P,) mask of the K parameters that were fitted.
        of_fitted: (K, K) covariance of these.
        kept_root: (P, L) root of the covariance of those kept, as `kept_root` returns it; zero rows for the others.
        with_hand_eye: (6, 6 + K) covariance of the hand-eye's twist ξ, T_mount·exp(ξ), with itself and with those
            fitted; stored only with terms of tier geometry, whose places depend on both.
    """
    sigmas = np.array([p.sigma if p.kept else np.nan for p in stack_parameters(model.terms)], float)
    sigmas[fitted] = np.sqrt(np.maximum(np.diag(of_fitted), 1e-300))
    ends = np.cumsum([len(term.parameters) for term in model.terms])[:-1]
    terms = tuple(map(Term.at, model.terms, [term.values for term in model.terms], np.split(sigmas, ends)))
    names = np.array([f"{term.name}.{p.name}" for term in terms for p in term.parameters], object)
    covariance = kept_root @ kept_root.T
    covariance[np.ix_(fitted, fitted)] += of_fitted
    present = np.diag(covariance) > 0
    of_effects = EffectsCovariance(tuple(names[present]), covariance[np.ix_(present, present)])
    if any(term.is_geometry for term in terms):
        cross_covariance = np.zeros((6, len(names)))
        cross_covariance[:, fitted] = with_hand_eye[:, 6:]
        known = np.hstack([with_hand_eye[:, :6], cross_covariance[:, present]])
        of_effects = replace(of_effects, with_hand_eye=known)
    return replace(model, terms=terms, effects_covariance=of_effects)


def printed_covariance(T_mount: Array, covariance: Array) -> Array:
    """Return (6, 6) of (rotation vector in rad, translation in length_unit), both in the mount frame.

    Args:
        T_mount: (4, 4) T_mount_scanner.
        covariance: (6, 6) of the right perturbation, rotation first.
    """
    J = np.zeros((6, 6))
    J[:3, :3] = frames.right_jacobian_inverse(Rotation.from_matrix(T_mount[:3, :3]).as_rotvec())
    J[3:, 3:] = T_mount[:3, :3]
    return J @ covariance @ J.T


def expanded_uncertainty(T_mount: Array, covariance: Array) -> Array:
    """Return (6,) U (k = 2) of rotation vector (rad) and translation (length_unit) in the mount frame."""
    return COVERAGE_FACTOR * np.sqrt(np.diag(printed_covariance(T_mount, covariance)))


def displacement(covariance: Array, middle: Array) -> float:
    """Return the expanded uncertainty U (k = 2), length_unit, of the position of a point under a hand-eye.

    The root of the summed variances in all three directions.

    Args:
        covariance: (6, 6) of the hand-eye's right perturbation, rotation first.
        middle: (3,) the point, scanner frame.
    """
    lever = np.hstack([-frames.skew(middle), np.eye(3)])
    return float(COVERAGE_FACTOR * np.sqrt(np.trace(lever @ covariance @ lever.T)))


def hand_eye_lines(
    T_mount: Array,
    covariance: Array,
    mount: str,
    length_unit: str,
    *,
    unknown: Sequence[str] = (),
    stated: bool = False,
) -> list[str]:
    """Return lines for people: position, mm, and rotation vector, mrad, with U (k = 2), in the mount frame.

    Args:
        T_mount: (4, 4) T_mount_scanner, length_unit.
        covariance: (6, 6) of the right perturbation, rotation first.
        mount: eye_to_hand | eye_in_hand.
        unknown: those of x, y, z, rx, ry, rz that the views do not show.
        stated: session.toml states the hand-eye, whose unknown numbers are then printed; else "not known".
    """
    frame = "base" if mount == "eye_to_hand" else "flange"
    to_mm = MILLIMETRES[length_unit]
    rotation = Rotation.from_matrix(T_mount[:3, :3]).as_rotvec() * 1e3
    U = expanded_uncertainty(T_mount, covariance) * np.repeat([1e3, to_mm], 3)

    def number(name: str, value: float, u: float) -> str:
        """Return a number with its U as text, or in words that the views do not show it."""
        if name in unknown:
            return f"{value:.5g} as stated" if stated else "not known"
        return value_uncertainty_text(value, u)

    position, turn = (
        ", ".join(f"{axis} {number(kind + axis, x, u)}" for axis, x, u in zip("xyz", values, size, strict=True))
        for kind, values, size in (("", T_mount[:3, 3] * to_mm, U[3:]), ("r", rotation, U[:3]))
    )
    return [
        f"Hand-eye T_{frame}_scanner, in the frame of the {frame}, ± U (k = 2) for a complete model:",
        f"  position {position} mm",
        f"  rotation vector {turn} mrad",
    ]


def uncertainty_scope(verdict: str | None) -> str:
    """Return a sentence on what U of the hand-eye leaves out: it does not cover an effect that is missing.

    Args:
        verdict: of the diagnosis: adequate | missing_effect | cannot_tell | unknown_effect; None: there is none yet.
    """
    if verdict in ("missing_effect", "cannot_tell"):
        return "The ± of the hand-eye are too small until the effect is added."
    if verdict == "unknown_effect":
        return "The ± of the hand-eye hold for a complete model, and something without a name is missing."
    found = "no effect is found missing" if verdict == "adequate" else "whether an effect is missing has not been asked"
    return f"U of the hand-eye holds for a complete model; {found}."

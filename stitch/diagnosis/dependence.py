"""What the displacements of whole views follow, by the dictionary of systematic laws: one table for all who ask.

A view that is off is off in all its points, and a mean over points whose sign changes with the pose hides that. So the
views themselves are asked, beside hand-eye and effects in use and over scatter alone: for every covariate, whether the
part, the far end of the arm or any one joint moves with it (F test; Bonferroni over all laws). What follows a covariate
may also be an error of the poses that repeats; this says where it is, and names no cause.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.systematic_laws import STEP, Dictionary, Law, Span, dictionary_of, stacked
from stitch.diagnosis.thresholds import DEPENDENCE_BINS, FAINT_SIGMAS
from stitch.numerics.distributions import f_tail
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import column_space, fit_columns
from stitch.numerics.reml import NOISE, at_variances
from stitch.observations.linear_model import LinearModel

# Family-wise p of the clearest covariate at which the views are said to follow it (custom).
FOLLOWS = 0.01
# Odds below which another covariate explains the displacements as well ("strong", Kass & Raftery 1995).
_AS_WELL = 20.0
# Columns of which less than this share is new beside the model say nothing; nor does what is smaller than the second.
_NEW_SHARE, _NOTHING = 1e-4, 1e-9
# Covariates whose correlation is less than 1 by so little are one.
_ALIKE = 1e-9
# Laws of each covariate whose own degrees of freedom of the scatter are asked, the clearest (time).
_ASKED_OF_EACH = 4
# Laws whose scatter is fitted anew, the clearest, and of more numbers than these (time).
_REFITTED, _FEW_NUMBERS, _REFITTED_OF_MANY = 12, 400, 3


@dataclass(frozen=True)
class Dependence:
    """How the views' displacement follows one covariate, by the law that explains most of it, with means over bins."""

    covariate: str
    unit: str
    place: str  # that moves with it
    shape: str  # in words: a step at view v012
    score: float  # share of the views' unexplained scatter that follows it, 0 … 1
    p_value: float  # over all laws
    p_beside: float  # the same beside the clearest covariate; 1 of that itself
    direction: Array  # (3,) unit, reference frame; its largest component is positive
    bins: Array  # (B,) middle of each bin, in the unit of the covariate
    mean: Array  # (B,) displacement along the direction, length_unit
    sigma: Array  # (B,) standard error, views as samples
    at: Array  # (V,) the covariate of every view
    moved: Array  # (V,) displacement of every view along the direction, length_unit

    @property
    def clear(self) -> bool:
        """True where chance does not explain it."""
        return self.p_value < FOLLOWS


def equally_clear(followed: Sequence[Dependence]) -> tuple[Dependence, ...]:
    """Return the dependences whose p is at most 20 times the least; () where not even the first is clear.

    Args:
        followed: the clearest first.
    """
    return tuple(x for x in followed if x.clear and x.p_value <= _AS_WELL * followed[0].p_value)


def also_clear(followed: Sequence[Dependence]) -> tuple[Dependence, ...]:
    """Return the dependences that are clear by themselves and beside the clearest one."""
    return tuple(x for x in followed if x.clear and x.p_beside < FOLLOWS)


def dependences(
    linear: LinearModel, named: Sequence[Ranked] = (), dictionary: Dictionary | None = None
) -> tuple[Dependence, ...]:
    """Return the covariates on which the displacements of whole views depend, by their best law, clearest first.

    Every covariate is listed once, significant or not. The result is () where no law can be tested.

    Args:
        named: effects that are said to be missing. Of covariates that are equal in these views, the one of a named
            effect is listed alone.
        dictionary: laws of these views; None: they are built here.
    """
    # Poses scatter independently here: random effects of joints would absorb what is sought.
    linear = linear.restricted(())
    laws = [law for law in (dictionary or dictionary_of(linear)).laws if law.is_full]
    if not laws:
        return ()
    clearest = _may_be_clearest(linear, laws)
    columns = {k: laws[k].reduced_columns(linear.observation) * laws[k].sizes for k in clearest}
    p_values = np.ones(len(laws))
    p_values[clearest] = _p_values(linear, list(columns.values()))
    twins = _twins_of_followed(linear, laws, named)
    # The law with the least p of each covariate, in the order of p.
    best: dict[str, int] = {}
    for k in sorted(clearest, key=lambda k: (p_values[k], k)):
        if laws[k].driver.name not in twins:
            best.setdefault(laws[k].driver.covariate, k)
    first, *others = best.values()
    beside_first = _p_values(_conditioned(linear, columns[first]), [columns[k] for k in others])
    beside = dict(zip(others, beside_first, strict=True))
    displacement = linear.view_displacements()
    tried = len(laws)  # Bonferroni: each law was chosen among all
    return tuple(
        _dependence(linear, laws[k], columns[k], displacement, tried * p_values[k], tried * beside.get(k, 1.0))
        for k in best.values()
    )


def _may_be_clearest(linear: LinearModel, laws: Sequence[Law]) -> list[int]:
    """Return the indices of the laws of each covariate with the least p, at most `_ASKED_OF_EACH` of each.

    This is a quick F test with the same degrees of freedom for all laws; `_p_values` then tests these few exactly. For
    a law with columns X, the explained square is bᵀ (Xᵀ X)⁺ b, b = Xᵀ y, by the eigenvalues of Xᵀ X that are not zero.
    """
    known = max(linear.mixed.size - linear.design.shape[1], 1)
    by_driver: dict[str, list[tuple[float, int]]] = {}
    for place, shapes, index in stacked(laws):
        sizes = laws[index[0, 0]].sizes
        information, vector = linear.information_of_motions(place.twists[:, :, place.independent], shapes)
        values, vectors = np.linalg.eigh(information * np.outer(sizes, sizes))
        seen = values > _NEW_SHARE**2 * np.maximum(values[:, -1:], _NOTHING)
        explained = np.einsum("sij,si->sj", vectors, vector * sizes) ** 2 / np.where(seen, values, np.inf)
        for k, square, rank in zip(index[:, 0].tolist(), explained.sum(axis=1), seen.sum(axis=1).tolist(), strict=True):
            chance = f_tail(float(square) / rank, rank, known) if rank else 1.0
            by_driver.setdefault(laws[k].driver.name, []).append((chance, k))
    return [k for chances in by_driver.values() for _, k in sorted(chances)[:_ASKED_OF_EACH]]


def _twins_of_followed(linear: LinearModel, laws: Sequence[Law], named: Sequence[Ranked]) -> set[str]:
    """Return the covariates that a named effect does not follow, but that correlate fully with one that it does.

    In these views the two are one column: it is listed once, as what the name says.

    Args:
        laws: whose drivers are the covariates.
        named: effects that are said to be missing; one follows a covariate if its clear columns contain a law of it.
    """
    covariates = {law.driver.name: law.driver.values for law in laws}
    correlations = np.atleast_2d(np.corrcoef(list(covariates.values())))
    # Itself is one: more correlate fully where there are twins.
    full = 1 - _ALIKE
    has_twin = dict(zip(covariates, (np.abs(correlations) > full).sum(axis=1) > 1, strict=True))
    named_spans = [Span(r.score.form.columns[:, np.abs(r.score.values) > FAINT_SIGMAS * r.score.sigmas]) for r in named]
    followed = {
        law.driver.name: law.driver.values
        for law in laws
        if has_twin[law.driver.name]
        # A joint follows columns of its own alone: j2_torque_nm.
        if law.place.joint is None or law.driver.name.startswith(f"j{law.place.joint}_")
        if any(span.contains(Span(law.reduced_columns(linear.observation) * law.sizes)) for span in named_spans)
    }
    rest = {name: x for name, x in covariates.items() if name not in followed}
    return {name for name, x in rest.items() if any(abs(np.corrcoef(x, y)[0, 1]) > full for y in followed.values())}


def _p_values(linear: LinearModel, columns: Sequence[Array]) -> list[float]:
    """Return the p-value of each matrix of columns (n, k), k depending on the law, by an F test.

    The least ones are computed again with variances of the scatter fitted beside these columns. Otherwise the error
    that they explain would count as scatter, and make itself look insignificant.
    """
    p_values = [_p_value(linear, x) for x in columns]
    refitted = _REFITTED if linear.mixed.size <= _FEW_NUMBERS else _REFITTED_OF_MANY
    for k in np.argsort(p_values, kind="stable")[:refitted]:
        scatter = at_variances(linear.mixed, _conditioned(linear, columns[k]).null.variances)
        p_values[k] = _p_value(replace(linear, null=scatter), columns[k])
    return p_values


def _p_value(linear: LinearModel, columns: Array) -> float:
    """Return the p-value of columns (n, k): an F test of the whitened residual's projection on them.

    F = |Uᵀ r|² / rank, U an orthonormal basis of the whitened columns beside hand-eye and effects in use. The degrees
    of freedom of the scatter follow Satterthwaite. 1 where the columns add nothing to the model.
    """
    white = linear.residual(columns)
    U = column_space(white) if np.abs(white).max(initial=0.0) > _NOTHING else white[:, :0]
    if not U.shape[1]:
        return 1.0
    known = linear.satterthwaite.degrees_of_freedom(linear.in_blocks(white))
    return f_tail(float(np.sum((U.T @ linear.white_residual) ** 2)) / U.shape[1], U.shape[1], max(known, 1.0))


def _conditioned(linear: LinearModel, columns: Array) -> LinearModel:
    """Return the linear model with columns (n, k) as further unknowns of any size, its variances fitted again.

    Only combinations of the columns that are new beside the model are added: others would make it singular.
    """
    white = linear.residual(columns)
    length = np.linalg.norm(white, axis=0)
    # What rounding leaves of a column that the model has already would be blown up beyond all numbers.
    new = length > _NOTHING
    columns, white, length = columns[:, new], white[:, new], length[new]
    _, s, Vt = np.linalg.svd(white / length, full_matrices=False)
    keep = s > _NEW_SHARE * s.max(initial=0.0)
    combined = (columns / length) @ (Vt[keep].T / s[keep])
    return linear.conditioned_on(combined, np.full(int(keep.sum()), np.inf))


def _dependence(
    linear: LinearModel, law: Law, columns: Array, displacement: Array, p_value: float, p_beside: float
) -> Dependence:
    """Return the result for one law: bins of the displacement along the direction in which it moves the part most.

    Args:
        columns: (n, k) of the law in the reduced observations, at plausible sizes.
        displacement: (V, 3) of each view at the part, reference frame, length_unit.
        p_value: over all laws.
        p_beside: the same beside the clearest covariate.
    """
    white = linear.residual(columns)
    # What the law explains, less what a refitted hand-eye and the effects in use absorb of it.
    explained = columns @ fit_columns(white, linear.white_residual)
    absorbed = linear.reduce(linear.design) @ fit_columns(linear.white_design, linear.whiten(explained[:, None])[:, 0])
    direction = np.linalg.svd(linear.observation.part_displacements(explained - absorbed), full_matrices=False)[2][0]
    direction = direction * np.sign(direction[np.abs(direction).argmax()])
    along = displacement @ direction
    x = law.driver.values
    split = law.driver.name == STEP and int(np.argmax(law.shapes[:, 0] > 0))
    middle, mean, sigma = bin_means(x, along, float(split) - 0.5 if split else None)
    square = np.sum((column_space(white).T @ linear.white_residual) ** 2)
    # With the noise that no motion of a view makes.
    total_square = float(np.sum(linear.white_residual**2)) + linear.mixed.noise_only[1] / linear.null.variances[NOISE]
    return Dependence(
        covariate=law.driver.covariate,
        unit=law.driver.unit,
        place=law.place.name,
        shape=law.shape,
        score=float(square / max(total_square, 1e-300)),
        p_value=min(p_value, 1.0),
        p_beside=min(p_beside, 1.0),
        direction=direction,
        bins=middle,
        mean=mean,
        sigma=sigma,
        at=x,
        moved=along,
    )


def bin_means(x: Array, y: Array, split: float | None) -> tuple[Array, Array, Array]:
    """Return middle, mean and standard error (B,) of values in bins of equal counts, or on both sides of a split.

    Args:
        x, y: (V,) abscissa and value of each view, in any units.
        split: x at which to divide in two; None: up to `DEPENDENCE_BINS` bins of equal counts, of two views at least.
    """
    order = np.argsort(x, kind="stable")
    if split is None:
        parts = [part for part in np.array_split(order, min(DEPENDENCE_BINS, max(len(x) // 2, 1))) if len(part)]
    else:
        parts = [order[x[order] < split], order[x[order] > split]]
    # Bins of one or two views have no scatter of their own to speak of: that of all stands in.
    spread = float(np.std(y, ddof=1)) if len(y) > 1 else 0.0
    middle = np.array([x[part].mean() for part in parts])
    mean = np.array([y[part].mean() for part in parts])
    sigma = np.array([(np.std(y[part], ddof=1) if len(part) > 2 else spread) / np.sqrt(len(part)) for part in parts])
    return middle, mean, sigma

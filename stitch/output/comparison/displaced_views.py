"""What the displacements of whole views follow: view order, time, covariates, angles, torques and moves of the joints.

A view that is off is off in all its points, and a mean over points whose sign changes with the pose hides that. So the
views themselves are asked: for every covariate, whether the part, the mount, or the joint that it belongs to moves with
it, beside hand-eye and effects in use (F test; Bonferroni over all shapes of all covariates). No cause is named.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.effects.contract import EFFECTS
from stitch.model.forward import pose_derivatives
from stitch.model.model import term_of
from stitch.numerics import frames
from stitch.numerics.distributions import f_tail
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import column_space, fit_columns
from stitch.numerics.reml import at_variances
from stitch.observations.linear_model import LinearModel
from stitch.session.measurement import Views

# Family-wise p of the clearest covariate at which the views are said to follow it (custom).
FOLLOWS = 0.01
VIEW_ORDER = "view order"
# Views at an end that make a step; steps that are tried at the most (time).
_MIN_VIEWS_AT_END, _MOST_STEPS = 2, 40
# Odds below which another covariate explains the displacements as well ("strong", Kass & Raftery 1995).
_AS_WELL = 20.0
# Columns of which less than this share is new beside the model say nothing.
_NEW_SHARE = 1e-4
# Trends whose scatter is fitted anew, the clearest, and of more numbers than these (time).
_REFITTED, _FEW_NUMBERS, _REFITTED_OF_MANY = 30, 400, 3
# Fewer values than these are no trend; bins that show it.
_MIN_VALUES, _BINS = 3, 5
_SAME_VALUE = 1e-9


@dataclass(frozen=True)
class FollowedCovariate:
    """One covariate, by the shape that explains most of the displacements; bins along the direction that follows it."""

    covariate: str
    unit: str
    shape: str  # in words: a step at view v012
    p_value: float  # over all shapes of all covariates
    p_beside: float  # the same beside the clearest covariate; 1 of that itself
    direction: Array  # (3,) unit, reference frame; its largest component is positive
    at: Array  # (B,) middle of each bin, in the unit of the covariate
    mean: Array  # (B,) displacement along the direction, length_unit
    sigma: Array  # (B,) standard error, views as samples

    @property
    def clear(self) -> bool:
        """True where chance does not explain it."""
        return self.p_value < FOLLOWS

    def document(self) -> dict[str, object]:
        """Return it as plain numbers and lists."""
        return {key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in vars(self).items()}


@dataclass(frozen=True)
class _Trend:
    """One way in which views may follow a covariate."""

    covariate: str
    unit: str
    shape: str
    values: Array  # (V,) of the covariate
    twists: Array  # (V, 6, k) of the views about the observation's centre
    split: float | None = None  # between the two bins of a step


def equally_clear(followed: Sequence[FollowedCovariate]) -> tuple[FollowedCovariate, ...]:
    """Return the clearest covariate and those that explain the displacements as well; () where nothing is clear."""
    return tuple(x for x in followed if x.clear and x.p_value <= _AS_WELL * followed[0].p_value)


def also_clear(followed: Sequence[FollowedCovariate]) -> tuple[FollowedCovariate, ...]:
    """Return those that are clear beside the clearest too."""
    return tuple(x for x in followed if x.clear and x.p_beside < FOLLOWS)


def followed_covariates(linear: LinearModel) -> tuple[FollowedCovariate, ...]:
    """Find what the displacements of whole views follow, clearest first; () where too few numbers are free."""
    linear = linear.restricted(())
    trends = list(_trends(linear))
    if not trends:
        return ()
    widths = [trend.twists.shape[2] for trend in trends]
    twists = np.concatenate([trend.twists.reshape(-1, k) for trend, k in zip(trends, widths, strict=True)], axis=1)
    columns = np.split(linear.observation.from_twists(twists), np.cumsum(widths)[:-1], axis=1)
    p_values = _p_values(linear, columns)
    best: dict[str, int] = {}
    for k in np.argsort(p_values, kind="stable"):
        best.setdefault(trends[k].covariate, int(k))
    first, *others = best.values()
    p_beside = dict(
        zip(others, _p_values(_conditioned(linear, columns[first]), [columns[k] for k in others]), strict=True)
    )

    tried = len(trends)  # each is the likeliest of all of them
    return tuple(
        _followed(
            linear,
            trends[k],
            columns[k],
            p_value=min(tried * p_values[k], 1.0),
            p_beside=min(tried * p_beside.get(k, 1.0), 1.0),
        )
        for k in best.values()
    )


def _p_values(linear: LinearModel, columns: Sequence[Array]) -> list[float]:
    """Return the chance of what each of some columns (n, k) explains.

    That of the clearest is under the scatter that is left beside them.

    What views follow counts as scatter as long as it is not taken out, and hides itself.
    """
    p_values = [_p_value(linear, x) for x in columns]
    refitted = _REFITTED if linear.mixed.size <= _FEW_NUMBERS else _REFITTED_OF_MANY
    for k in np.argsort(p_values, kind="stable")[:refitted]:
        scatter = at_variances(linear.mixed, _conditioned(linear, columns[k]).null.variances)
        p_values[k] = _p_value(replace(linear, null=scatter), columns[k])
    return p_values


def _p_value(linear: LinearModel, columns: Array) -> float:
    """Return the chance of what columns (n, k) explain, of a scatter that is known to so many degrees of freedom."""
    white = linear.residual(columns)
    U = column_space(white) if np.abs(white).max(initial=0.0) > _SAME_VALUE else white[:, :0]
    if not U.shape[1]:
        return 1.0
    known = linear.satterthwaite.degrees_of_freedom(linear.in_blocks(white))
    return f_tail(float(np.sum((U.T @ linear.white_residual) ** 2)) / U.shape[1], U.shape[1], max(known, 1.0))


def _conditioned(linear: LinearModel, columns: Array) -> LinearModel:
    """Return the model with the combinations of columns (n, k) that it does not explain itself."""
    white = linear.residual(columns)
    length = np.maximum(np.linalg.norm(white, axis=0), 1e-300)
    _, s, turned = np.linalg.svd(white / length, full_matrices=False)
    keep = s > _NEW_SHARE * s[0]
    combined = (columns / length) @ (turned[keep].T / s[keep])
    return linear.conditioned_on(combined, np.full(int(keep.sum()), np.inf))


def _followed(
    linear: LinearModel, trend: _Trend, columns: Array, *, p_value: float, p_beside: float
) -> FollowedCovariate:
    """Return the bins of one trend along the direction in which what it explains is largest."""
    moved = columns @ fit_columns(linear.residual(columns), linear.white_residual)
    held = linear.reduce(linear.design) @ fit_columns(linear.white_design, linear.whiten(moved[:, None])[:, 0])
    direction = np.linalg.svd(linear.observation.part_displacements(moved - held), full_matrices=False)[2][0]
    direction = direction * np.sign(direction[np.abs(direction).argmax()])
    along = linear.view_displacements() @ direction
    x = trend.values
    order = np.argsort(x, kind="stable")
    if trend.split is not None:
        parts = [order[x[order] < trend.split], order[x[order] > trend.split]]
    else:
        parts = [part for part in np.array_split(order, min(_BINS, max(len(x) // 2, 1))) if len(part)]
    spread = float(np.std(along, ddof=1))
    sigmas = [(np.std(along[part], ddof=1) if len(part) > 2 else spread) / np.sqrt(len(part)) for part in parts]
    return FollowedCovariate(
        covariate=trend.covariate,
        unit=trend.unit,
        shape=trend.shape,
        p_value=p_value,
        p_beside=p_beside,
        direction=direction,
        at=np.array([x[part].mean() for part in parts]),
        mean=np.array([along[part].mean() for part in parts]),
        sigma=np.array(sigmas),
    )


def _trends(linear: LinearModel) -> Iterator[_Trend]:
    """Give all trends that are tried."""
    measurement = linear.measurement
    views = measurement.views
    still = np.broadcast_to(np.eye(6), (views.count, 6, 6))
    to_centre = frames.make(np.eye(3), -linear.observation.centre)
    carried = frames.adjoint(to_centre @ measurement.capture.T_reference_flange)
    # Of the part where it lies, and of what the flange carries: both are whole views.
    for moved in (still, carried):
        yield from _steps(views, moved)
        for name, unit, values in _slow_covariates(views):
            x = 2 * (values - values.min()) / np.ptp(values) - 1
            yield _Trend(name, unit, "a line", values, moved * x[:, None, None])
            yield _Trend(name, unit, "a bend", values, moved * (1.5 * x**2 - 0.5)[:, None, None])
    if views.joints.shape[1] and measurement.robot is not None:
        offset = term_of(measurement, EFFECTS["joint_offset"])
        motions = next(pose_derivatives(measurement, linear.model, [offset], linear.observation.centre))
        yield from _joint_trends(views, motions)


def _steps(views: Views, moved: Array) -> Iterator[_Trend]:
    """Give the trends in which from some view on all are displaced alike."""
    starts = np.arange(_MIN_VIEWS_AT_END, views.count - _MIN_VIEWS_AT_END + 1)
    picked = starts[np.unique(np.linspace(0, len(starts) - 1, min(len(starts), _MOST_STEPS)).astype(int))]
    order = np.arange(views.count, dtype=float)
    for start in picked if len(starts) else ():
        shape = f"a step at view {views.names[views.number[start]]}"
        yield _Trend(VIEW_ORDER, "view", shape, order, moved * (order >= start)[:, None, None], start - 0.5)


def _slow_covariates(views: Views) -> Iterator[tuple[str, str, Array]]:
    """Give name, unit and values (V,) of time and all columns of the views that take several values."""
    known = [("time", "s", views.time)] if views.has("time") else []
    known += [(name, "", values) for name, values in views.covariates.items()]
    for name, unit, values in known:
        if len(np.unique(values)) >= _MIN_VALUES and np.ptp(values) > _SAME_VALUE:
            yield name, unit, values


def _joint_trends(views: Views, motions: Array) -> Iterator[_Trend]:
    """What a joint may be off by: a constant, waves along its angle, its load, the way and how far it came, its speed.

    Args:
        motions: (n, V, 6) twists of the views by a radian of each joint.
    """
    q = views.joints
    for k, moved in enumerate(motions[..., None]):
        name, degrees = f"j{k + 1}", np.degrees(q[:, k])
        yield _Trend(name, "deg", "a wrong zero of the joint", degrees, moved)
        for periods, words in ((1, "a wave, once a turn"), (2, "a wave, twice a turn")):
            waves = np.stack([np.sin(periods * q[:, k]), np.cos(periods * q[:, k])], axis=1)
            yield _Trend(name, "deg", words, degrees, moved * waves[:, None, :])
        carried = [t for t, joint in enumerate(views.torques.joint) if joint == k]
        known = [
            (f"approach of {name}", "", "a play of the joint", views.approach[:, k].astype(float)),
            (f"last move of {name}", "deg", "a share of the move", np.degrees(q[:, k] - views.previous[:, k])),
            *((f"torque {views.torques.names[t]}", "N m", "a spring", views.torques.values[:, t]) for t in carried),
        ]
        for covariate, unit, words, values in known:
            if np.ptp(values) > _SAME_VALUE:
                yield _Trend(covariate, unit, words, values, moved * values[:, None, None])
    if views.velocity is not None and len(motions):
        speed = np.degrees(np.linalg.norm(views.velocity, axis=1))
        late = np.einsum("kvi,vk->vi", motions, views.velocity)[..., None]
        yield _Trend("speed", "deg/s", "a delay", speed, late)

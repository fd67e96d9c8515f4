"""All that may be wrong about the places of a run, carried through the fit and through register.

Register moves every view by δ̂ = K (d + n): d is how far robot and model misplace the view, n what noise and the
scanner's smooth errors, those of all scans and those of each, make of its overlaps, and K = (H + Λ)⁻¹ H with the
information H of the overlaps and the precision Λ of the robot's pose. Hand-eye and effects are x̂ = X u, a linear answer
to what the same overlaps show. So the registered views err by a known linear map of whatever errs,

    η = −(I − K) r + B x̂ + K (n + a·f),     x̂ = X (r + n + a·f),     B = (I − K) J_views − K J_points,

with errors r of the poses, smooth errors f of the scanner and what the overlaps make of them, a. f, and parameters of
effects that change points, move the points themselves as well. The sizes are posterior means of the variances.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from stitch.errors import InputError
from stitch.fit.coarse import REUSED
from stitch.fit.fit import WEAK
from stitch.fusion.register import METHODS, normal_equations, prior_precision
from stitch.model.forward import PointSlopes, corrected_capture, moves_points
from stitch.model.model import kept_root, sizes_of, stack_parameters, values_of
from stitch.numerics import frames
from stitch.numerics.frames import Array, Mask
from stitch.numerics.reml import NOISE, fit_variances
from stitch.numerics.variance_posterior import mean_variances, satterthwaite
from stitch.observations.pose_errors import DRIFT_MEMORY, JOINT_SCATTER, STOP_COMPONENTS, prior_pose_errors
from stitch.observations.surfaces.effect_columns import apparent_twists, view_columns
from stitch.observations.surfaces.hand_eye_fit import FittedEffects, HandEyeSolution, hand_eye_jacobian, solve_hand_eye
from stitch.observations.surfaces.scanner_errors import (
    COARSE,
    SHARED,
    half_field,
    sum_smooth_errors,
    view_error_likelihood,
)
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, unconstrained_poses
from stitch.plugins.metrology.place_errors import ErrorSource, PlaceErrors
from stitch.plugins.metrology.scan_errors import ScanErrors, fit_scan_errors, scan_error_twists
from stitch.run_data import RunData
from stitch.session.capture import Capture
from stitch.system.threads import library_threads_off

# Sources as people call them.
SCATTER = "robot: scatter of the poses"
ARM = "robot: joints and links"
WANDERING = "robot: wandering in time"
STOP = "robot: shared by the scans of a stop"
OVERLAPS = "noise of the overlaps"
SCANNER = "scanner: smooth errors"
# On a ball this is a shell of one thickness, and a way of each view along its ray: no overlap shows it.
INCIDENCE = "scanner: error over incidence"
SCAN = "scanner: smooth errors new in each scan"
OTHER_RUN = "model of another run"
OTHER_ARM = "arm of another run"
UNSEEN = "hand-eye: not shown by the motions"
# What a session does not show of itself.
NOT_INCLUDED = (
    "scale of the scanner, where range_scale is not in the model: an artefact of known length shows it",
    "an error over incidence that is larger than usual: a ball of known diameter shows it",
    "temperature of the part, against 20 °C and over the session",
    "clamping of the part, and how it bends",
    "effects that the model lacks (stitch diagnose)",
    "shape and roughness of the surface within the points of a feature",
)
_MANY = 1e6
# Directions with a smaller share of a component's largest variance are rounding.
_ROUNDING = 1e-12
# A source of one name: its modes as errors of views and of fitted parameters, and how well its size is known.
_Modes = tuple[str, tuple[Array, Array], float]


def place_errors(run: RunData) -> PlaceErrors:
    """Return the places of a run's points with all that its own views say may be wrong about them.

    Raises:
        InputError: a run without clouds.
        NoResultError: no two views overlap.
    """
    with library_threads_off():
        chain = error_chain(run)
        terms = [term for term in run.terms if moves_points([term])]
        sources, scan_errors = _sources(run, chain)
        return PlaceErrors(
            measurement=run.measurement,
            capture=chain.capture,
            poses=run.poses,
            centre=chain.unconstrained.overlaps.gram.centre,
            sources=sources,
            slopes=PointSlopes(run.measurement, terms, run.model) if terms else None,
            half=half_field(run.measurement),
            scan_errors=scan_errors,
        )


@dataclass(frozen=True)
class ErrorChain:
    """The linear maps of the module's head; twists (6V,) about the centre of the overlaps, F fitted parameters."""

    capture: Capture
    unconstrained: UnconstrainedPoses
    solution: HandEyeSolution
    fitted: Mask  # (P,) of all parameters of effects
    of_points: Mask  # (P,) of effects that change points
    columns: Array  # (6V, P)
    follow: Array  # (6V, 6V) K
    answer: Array  # (6 + F, 6V) X; zero for the model of another run
    to_views: Array  # (6V, 6 + F) B

    def of_poses(self, root: Array) -> tuple[Array, Array]:
        """What errors of poses (6V, m) make of the views (6V, m) and of the parameters (6 + F, m)."""
        x = self.answer @ root
        return self.follow @ root - root + self.to_views @ x, x

    def of_overlaps(self, twists: Array) -> tuple[Array, Array]:
        """The same of errors of what the overlaps show, twists (6V, m)."""
        x = self.answer @ twists
        return self.follow @ twists + self.to_views @ x, x

    def of_model(self, x: Array) -> tuple[Array, Array]:
        """The same of errors of the parameters (6 + F, m) themselves."""
        return self.to_views @ x, x


def error_chain(run: RunData) -> ErrorChain:
    """Return the linear maps by which errors reach the registered views of a run.

    Raises:
        InputError: a run without clouds.
        NoResultError: no two views overlap.
    """
    if not run.measurement.capture.scans or run.registered is None:
        raise InputError(f"{run.session.name}: has no clouds, so no surface; to fix: name a run of scans")
    measurement = run.measurement
    model = run.model
    capture = corrected_capture(measurement, model)
    unconstrained = unconstrained_poses(capture, capture.poses(model.T_mount), run.gate)
    columns = view_columns(measurement, model, unconstrained)
    given = REUSED in run.stages[0].note
    fitted = np.array([p.fitted and (given or not p.kept) for p in stack_parameters(model.terms)], bool)
    of_points = np.array([moves_points([term]) for term in model.terms for _ in term.parameters], bool)
    effects = FittedEffects((columns[:, fitted],), values_of(model.terms)[fitted], WEAK * sizes_of(model.terms)[fitted])
    solution = solve_hand_eye([capture], [unconstrained], model.T_mount, effects)
    part = solution.rig.parts[0]
    answer = solution.gain @ part.reduced_poses.reduction
    centre = unconstrained.overlaps.gram.centre
    follow = _follow_overlaps(run, capture, solution, centre)
    of_views = np.column_stack(
        [hand_eye_jacobian(part.capture, part.T_mount, centre), columns[:, fitted] * ~of_points[fitted]]
    )
    by_points = np.column_stack([np.zeros((len(columns), 6)), columns[:, fitted] * of_points[fitted]])
    return ErrorChain(
        capture=capture,
        unconstrained=unconstrained,
        solution=solution,
        fitted=fitted,
        of_points=of_points,
        columns=columns,
        follow=follow,
        answer=np.zeros_like(answer) if given else answer,
        to_views=of_views - follow @ (of_views + by_points),
    )


def _follow_overlaps(run: RunData, capture: Capture, solution: HandEyeSolution, centre: Array) -> Array:
    """(6V, 6V) K: by how much of what the overlaps show register moves the views, twists about `centre` (3,)."""
    assert run.registered is not None
    scatter = solution.scatter[0]
    method = METHODS[run.register_method]
    H = normal_equations(run.registered, capture, run.poses, run.poses_model, scatter=scatter, method=method).H
    about = run.registered.gram.centre
    held = np.zeros_like(H)
    for v, precision in enumerate(prior_precision(capture, scatter, about)):
        held[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] = precision
    shift = np.kron(np.eye(len(run.poses)), frames.adjoint(frames.make(np.eye(3), centre - about)))
    K = np.eye(len(H)) - np.linalg.solve(H, held)
    return np.linalg.solve(shift, K @ shift)


def _sources(run: RunData, chain: ErrorChain) -> tuple[tuple[ErrorSource, ...], ScanErrors | None]:
    """Return all sources, and the smooth errors that are new in each scan."""
    twists, shared, errors = _smooth_errors(run, chain)
    of_scans = list[Array]()
    if errors is not None:
        views = range(len(run.poses))
        of_scans = [scan_error_twists(run.measurement, chain.unconstrained, errors, v) for v in views]
    kinds = len(twists.T)
    sources = [_source(chain, (name, chain.of_overlaps(twists @ f), nu), kinds, f) for name, f, nu in shared]
    smooth = np.hstack([*(twists @ shapes for _, shapes, _ in shared), *of_scans])
    sources += [_source(chain, modes, kinds) for modes in _pose_modes(run, chain, smooth)]
    sources += [_source(chain, modes, kinds) for modes in _model_modes(run, chain)]
    for v, moved in enumerate(of_scans):
        assert errors is not None
        # Each scan is a row of its own, and one size is known for all.
        modes = (SCAN, chain.of_overlaps(moved), errors.degrees / len(of_scans))
        sources.append(replace(_source(chain, modes, kinds), scan=v))
    return tuple(sources), errors


def _source(chain: ErrorChain, modes: _Modes, kinds: int, shapes: Array | None = None) -> ErrorSource:
    """Return a source by its modes; those of the scanner's own are shapes (kinds, m) of its smooth errors."""
    name, (views, x), degrees = modes
    parameters = np.zeros((len(chain.fitted), x.shape[1]))
    parameters[chain.fitted] = x[6:]
    field = np.zeros((kinds, x.shape[1])) if shapes is None else shapes
    return ErrorSource(name, views, np.vstack([parameters[chain.of_points], field]), degrees)


def _smooth_errors(run: RunData, chain: ErrorChain) -> tuple[Array, list[tuple[str, Array, float]], ScanErrors | None]:
    """Return twists (6V, K) that the overlaps show for unit smooth errors which all views share, by source what they
    are (K, m) as m independent ones of unit variance with degrees of freedom, and those that are new in each scan.

    The overlaps show a part of the errors themselves: what counts is their second moment given that, since no point is
    corrected by it.
    """
    sums, noise = sum_smooth_errors(run.measurement, chain.unconstrained)
    twists = apparent_twists(sums, chain.unconstrained)
    units = np.split(np.eye(twists.shape[1]), [-1], axis=1)
    if not np.isfinite(noise):
        return twists, [(SCANNER, 0 * units[0], _MANY)], None
    # Beside errors of single views, which else pass for shared ones; finer shared ones are not among the shapes here.
    of_views, _ = sum_smooth_errors(run.measurement, chain.unconstrained, per_view=True)
    likelihood = view_error_likelihood(of_views, chain.unconstrained, noise)
    likelihood = replace(likelihood, design=(likelihood.design[SHARED][:, :COARSE], *likelihood.design[1:]))
    likeliest = likelihood.map_shares
    estimates = []
    shared = []
    for cause, name in enumerate((SCANNER, INCIDENCE)):
        mean, moment, degrees = likelihood.error_moments(cause, likeliest)
        estimates.append(noise * mean)
        shared.append((name, units[cause] @ (noise * np.linalg.cholesky(moment)), degrees))
    half = half_field(run.measurement)
    return twists, shared, fit_scan_errors(run.measurement, chain.unconstrained, noise, np.concatenate(estimates), half)


def _pose_modes(run: RunData, chain: ErrorChain, smooth: Array) -> Iterator[_Modes]:
    """Errors of the poses and the noise of the overlaps, as large as the views show them beside smooth errors (6V, K)
    of the scanner, which are sources of their own."""
    rig = chain.solution.rig
    g = chain.unconstrained.overlaps.gram
    errors = prior_pose_errors([run.measurement], run.model, [g.centre]).of_ordinary_arm
    errors = errors.restricted(errors.causes - {JOINT_SCATTER})
    reduced_smooth = rig.reduce([smooth])
    mixed = replace(rig.mixed(errors), fixed=(reduced_smooth @ reduced_smooth.T)[None])
    sizes = fit_variances(mixed, both_starts=True)
    sigma = np.sqrt(mean_variances(mixed, sizes))
    known = 2 / np.clip(np.diag(satterthwaite(mixed, sizes).spread), 2 / _MANY, 2.0)
    carried = frames.adjoint(frames.make(np.eye(3), -g.centre) @ chain.capture.T_reference_flange)
    for k, axes in enumerate((slice(0, 3), slice(3, 6))):
        root = block_diag(*carried[:, :, axes])
        yield SCATTER, chain.of_poses(sigma[k] * root), float(known[k])
    visible = g.visible
    noise = sigma[NOISE] * visible.scale[:, None] * visible.vectors * np.sqrt(g.variance / visible.values)
    yield OVERLAPS, chain.of_overlaps(noise), float(known[NOISE])
    names = dict.fromkeys(DRIFT_MEMORY, WANDERING) | dict.fromkeys(STOP_COMPONENTS, STOP)
    for k, (name, component) in enumerate(zip(errors.names, errors.components, strict=True), NOISE + 1):
        yield names.get(name, ARM), chain.of_poses(sigma[k] * _root(component)), float(known[k])


def _model_modes(run: RunData, chain: ErrorChain) -> Iterator[_Modes]:
    """Errors of a model that other views fitted, or of what these did not show."""
    kept = chain.columns @ kept_root(run.terms, run.model.effects_covariance)
    if kept.any():
        yield OTHER_ARM, chain.of_poses(kept), _MANY
    solution = chain.solution
    if not chain.answer.any():
        effects = run.model.effects_covariance.root(run.terms)[chain.fitted]
        yield OTHER_RUN, chain.of_model(block_diag(_root(run.mount_covariance), effects)), _MANY
        return
    yield UNSEEN, chain.of_model(solution.covariance @ _root(solution.prior)), _MANY
    if solution.hidden.size:
        hand_eye = np.eye(6 + int(chain.fitted.sum()))[:, :6]
        yield UNSEEN, chain.of_model(hand_eye @ solution.hidden), _MANY


def _root(covariance: Array) -> Array:
    """(n, m) L with L·Lᵀ the covariance (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > _ROUNDING * max(values[-1], 1e-300)
    return vectors[:, keep] * np.sqrt(values[keep])

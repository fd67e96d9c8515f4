"""What each view says of one sphere, predicted less measured, as residuals, Jacobians and one weighted solve."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from stitch import frames
from stitch.calibrate.sphere_views import SphereView
from stitch.frames import Array

# Step of the central differences (rad and lengths).
_STEP = 1e-5


@dataclass(frozen=True)
class SphereState:
    """The unknowns: hand-eye T_mount_scanner (4, 4), centre (3,) in the reference frame, radius."""

    T_mount: Array
    centre: Array
    radius: float

    def moved(self, x: Array) -> "SphereState":
        """The state after a step (9,) or, with the radius, (10,): twist of the hand-eye, centre."""
        radius = self.radius + (x[9] if len(x) > 9 else 0.0)
        return SphereState(self.T_mount @ frames.exp(x[:6]), self.centre + x[6:9], radius)


def sphere_distances(G: Array, points: Array, state: SphereState) -> Array:
    """Distances (N,) of one view's points (N, 3) from the sphere, positive outside."""
    return np.asarray(np.linalg.norm(frames.transform(G @ state.T_mount, points) - state.centre, axis=1) - state.radius)


def _residuals(G: Array, views: Sequence[SphereView], state: SphereState) -> tuple[list[Array], list[Array]]:
    """Predicted less measured circle or sphere of each view, (k + 1,), and its response to a shift, (k + 1, 3)."""
    seen = frames.transform(frames.inverse(G @ state.T_mount), state.centre[None])[:, 0]
    out, response = [], []
    for view, q in zip(views, seen, strict=True):
        if view.is_line:
            height = float((q - view.foot) @ view.normal)
            rho = np.sqrt(max(state.radius**2 - height**2, 1e-4 * state.radius**2))
            last = -height / rho * view.normal
        else:
            rho, last = state.radius, np.zeros(3)
        out.append(np.append(view.directions @ q, rho) - view.measured)
        response.append(np.vstack([view.directions, last]))
    return out, response


def solve_sphere(
    G: Array, views: Sequence[SphereView], state: SphereState, weights: Sequence[Array], n: int
) -> SphereState:
    """Weighted least squares over the circles and spheres of the views, weights (k + 1, k + 1) each."""
    W = [np.linalg.cholesky(w).T for w in weights]

    def residual(x: Array) -> Array:
        return np.concatenate([w @ r for w, r in zip(W, _residuals(G, views, state.moved(x))[0], strict=True)])

    return state.moved(least_squares(residual, np.zeros(n), "3-point", x_scale="jac").x)


def linearise_sphere(
    G: Array, views: Sequence[SphereView], state: SphereState, n: int
) -> tuple[list[Array], list[Array], list[Array]]:
    """Residuals, their Jacobians (k + 1, n) and responses to a shift, by view."""
    e, response = _residuals(G, views, state)
    sides = [[_residuals(G, views, state.moved(s * h))[0] for s in (1, -1)] for h in _STEP * np.eye(n)]
    jacobian = [
        np.column_stack([(plus[v] - minus[v]) / (2 * _STEP) for plus, minus in sides]) for v in range(len(views))
    ]
    return e, jacobian, response

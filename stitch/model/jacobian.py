"""How poses answer to the parameters of a term, by central differences about a model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.imperfect_arm import FlangeSlopes, Links, flange_slopes
from stitch.measurement.measurement import Measurement
from stitch.model.forward import ChainErrors, chain_errors, moves_arm, perturbed_frames
from stitch.model.model import Model
from stitch.model.term import Term

# Step as a share of the plausible size: errors of third order stay far below the noise. A time constant is stepped
# less, since the effect is not linear in it.
STEP, _STEP_GRIDDED = 0.1, 0.005


def pose_derivatives(measurement: Measurement, model: Model, terms: Sequence[Term], centre: Array) -> Iterator[Array]:
    """Per term (P, V, 6) left twists of the views about `centre`, reference frame, per unit of each parameter.

    About the model with the term in place of its own, or added at its values. Differences are taken of what an effect
    does to joints, links, mount and part alone; from there the chain of frames carries them.
    """
    chain = None
    for term in terms:
        about = model.with_term(term)
        others = chain_errors(measurement, model.without(term.name).terms)
        errors = chain_errors(measurement, [term], others)
        if chain is None or not chain.is_about(errors):
            chain = _ChainJacobian(measurement, about, errors, centre)
        moved = [_pose_derivative(measurement, others, term, i, chain) for i in range(len(term.parameters))]
        yield np.array(moved).reshape(len(moved), measurement.views.count, 6)


def _pose_derivative(
    measurement: Measurement, others: ChainErrors, term: Term, i: int, chain: "_ChainJacobian"
) -> Array:
    """(V, 6) of one parameter beside what all other terms do."""
    parameter = term.parameters[i]
    if parameter.discrete:
        return np.zeros((measurement.views.count, 6))
    size = (_STEP_GRIDDED if parameter.grid else STEP) * parameter.typical
    up, down = (chain_errors(measurement, [t], others) for t in step_parameter(term, i, size))
    return chain.twists(up, down, moves_arm(term)) / (2 * size)


@dataclass(frozen=True)
class _ChainJacobian:
    """How the views answer to small errors of the chain of frames, about those of a model."""

    measurement: Measurement
    about: Model
    errors: ChainErrors
    centre: Array  # (3,)

    def is_about(self, errors: ChainErrors) -> bool:
        own, other = ((e.joints, *vars(e.links).values(), e.mount, e.part) for e in (self.errors, errors))
        return all(np.array_equal(a, b) for a, b in zip(own, other, strict=True))

    def twists(self, up: ChainErrors, down: ChainErrors, of_arm: bool) -> Array:
        """(V, 6) left twists of the views between two errors near these."""
        if of_arm and self.measurement.robot is not None:
            links = {name: own - getattr(down.links, name) for name, own in vars(up.links).items()}
            return _apply_matrices(self.of_flange, self.flange.twists(up.joints - down.joints, Links(**links)))
        return _apply_matrices(self.of_mount, up.mount - down.mount) + _apply_matrices(
            self.of_part, up.part - down.part
        )

    @cached_property
    def flange(self) -> FlangeSlopes:
        """Body twists of the flange."""
        assert self.measurement.robot is not None
        return flange_slopes(self.measurement.robot, self.errors.joints, self.errors.links)

    @cached_property
    def of_flange(self) -> Array:
        """(V, 6, 6) for body twists of the flange."""
        if self.measurement.eye_to_hand:
            # (T·exp ξ)⁻¹ = exp(−ξ)·T⁻¹: the flange's own side stands left.
            return -frames.adjoint(self._to_centre @ frames.exp(-self.errors.part))
        return frames.adjoint(self._to_centre @ self._left)

    @cached_property
    def of_mount(self) -> Array:
        """(V, 6, 6) for changes of the twist of the mount: exp(m + δ) = exp(J δ)·exp(m)."""
        carried = frames.adjoint(self._to_centre @ self._left @ self.about.T_mount)
        return np.asarray(carried @ frames.left_jacobian(self.errors.mount))

    @cached_property
    def of_part(self) -> Array:
        """(V, 6, 6) for changes of the twist of the part."""
        return -np.asarray(frames.adjoint(self._to_centre) @ frames.left_jacobian(-self.errors.part))

    @cached_property
    def _left(self) -> Array:
        """(V, 4, 4) what stands left of the hand-eye."""
        return perturbed_frames(self.measurement, self.about.terms)[0]

    @property
    def _to_centre(self) -> Array:
        return frames.make(np.eye(3), -self.centre)


def _apply_matrices(matrix: Array, vectors: Array) -> Array:
    """(V, 6) of (V, 6, 6) and (V, 6)."""
    return np.asarray((matrix @ vectors[..., None])[..., 0])


def step_parameter(term: Term, i: int, size: float) -> tuple[Term, Term]:
    """The term with parameter i larger and smaller by a step."""
    step = size * np.eye(len(term.parameters))[i]
    return term.at(term.values + step), term.at(term.values - step)

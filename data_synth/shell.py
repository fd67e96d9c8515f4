"""An elastic panel: a thin cylindrical shell with stringers, by finite elements (scikit-fem).

Bogner-Fox-Schmit elements (bicubic, continuous slopes) in all three displacements: the panel is a rectangle in its
axial and arc coordinates, so a conforming element with second derivatives fits it exactly. A flat plate element such
as Morley's would miss the curvature that makes the panel stiff within its plane.
Strains after Love (Timoshenko & Woinowsky-Krieger 1959, ch. 15; w counts outwards): rigid motions leave none.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import skfem
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Laminate:
    """A carbon-fibre skin, quasi-isotropic, with stringers along the axis spread over their pitch. N, mm, t."""

    modulus: float = 55e3
    poisson: float = 0.31
    thickness: float = 3.0
    density: float = 1.6e-9
    stringer_modulus: float = 90e3  # along the fibres, mostly axial
    stringer_area: float = 180.0
    stringer_inertia: float = 2.4e4  # about its own middle with the skin working along, mm⁴
    stringer_pitch: float = 256.0  # eight on the whole panel


class Shell:
    """Free panel; u along the axis, v along the arc, w outwards, at any (x, s) in mm."""

    def __init__(self, radius: float, length: float, width: float, laminate: Laminate, cells: tuple[int, int]) -> None:
        x, s = (np.linspace(-extent / 2, extent / 2, n + 1) for extent, n in zip((length, width), cells, strict=True))
        mesh = skfem.MeshQuad.init_tensor(x, s)
        self.radius, self.length, self.width, self.laminate = radius, length, width, laminate
        self._basis = skfem.Basis(mesh, skfem.ElementQuadBFS(), intorder=6)
        self.size = self._basis.N
        self._x, self._s = self._basis.global_coordinates().value.reshape(2, -1)
        self._area = np.asarray(self._basis.dx).ravel()
        self.stiffness = self._stiffness()

    def _operators(self) -> dict[str, sp.csr_matrix]:
        """Values and derivatives of a scalar field at the quadrature points, as matrices over its unknowns."""
        fields = [function[0] for function in self._basis.basis]
        rows = np.arange(self._area.size).reshape(self._basis.dx.shape)
        picks = {
            "1": lambda f: f.value,
            "x": lambda f: f.grad[0],
            "s": lambda f: f.grad[1],
            "xx": lambda f: f.hess[0, 0],
            "ss": lambda f: f.hess[1, 1],
            "xs": lambda f: f.hess[0, 1],
        }
        out = {}
        for name, pick in picks.items():
            values = np.stack([np.broadcast_to(pick(f), rows.shape) for f in fields])
            columns = np.broadcast_to(self._basis.element_dofs[:, :, None], values.shape)
            lines = np.broadcast_to(rows, values.shape)
            matrix = sp.coo_matrix((values.ravel(), (lines.ravel(), columns.ravel())), (rows.size, self.size))
            out[name] = matrix.tocsr()
        self._value = out["1"]
        return out

    def _stiffness(self) -> sp.csc_matrix:
        D, R, m = self._operators(), self.radius, self.laminate
        none = sp.csr_matrix(D["1"].shape)
        strain = [[D["x"], none, none], [none, D["s"], D["1"] / R], [D["s"], D["x"], none]]
        bend = [[none, none, -D["xx"]], [none, D["s"] / R, -D["ss"]], [none, 2 * D["x"] / R, -2 * D["xs"]]]
        plane = np.array([[1, m.poisson, 0], [m.poisson, 1, 0], [0, 0, (1 - m.poisson) / 2]])
        plane = plane * m.modulus / (1 - m.poisson**2)
        membrane, bending = plane * m.thickness, plane * m.thickness**3 / 12
        membrane[0, 0] += m.stringer_modulus * m.stringer_area / m.stringer_pitch
        bending[0, 0] += m.stringer_modulus * m.stringer_inertia / m.stringer_pitch
        weight = sp.diags(self._area)
        total = sp.csr_matrix((3 * self.size, 3 * self.size))
        for rows, law in ((strain, membrane), (bend, bending)):
            B = [sp.hstack(row).tocsr() for row in rows]
            for i in range(3):
                for j in range(3):
                    if law[i, j]:
                        total = total + law[i, j] * (B[i].T @ weight @ B[j])
        return total.tocsc()

    def at(self, xs: Array) -> sp.csr_matrix:
        """(3N, 3·size): displacements u, v, w at points (N, 2), point by point."""
        probe = sp.csr_matrix(self._basis.probes(np.asarray(xs, float).T))
        whole = sp.block_diag([probe] * 3).tocsr()
        n = len(xs)
        return whole[np.arange(3 * n).reshape(3, n).T.ravel()]

    def axes(self, s: Array) -> Array:
        """(N, 3, 3) directions of u, v, w as columns in the panel frame (x, y across, z outwards)."""
        a, zero, one = s / self.radius, np.zeros(len(s)), np.ones(len(s))
        u, v, w = [one, zero, zero], [zero, np.cos(a), -np.sin(a)], [zero, np.sin(a), np.cos(a)]
        return np.stack([np.stack(axis, -1) for axis in (u, v, w)], axis=-1)

    def weight(self, gravity: Array) -> Array:
        """Load (3·size,) of the panel's own weight; gravity (3,) in mm/s², panel frame."""
        m = self.laminate
        mass = m.density * (m.thickness + m.stringer_area / m.stringer_pitch)
        local = np.einsum("nij,i->nj", self.axes(self._s), gravity) * (mass * self._area)[:, None]
        return np.concatenate([self._value.T @ local[:, k] for k in range(3)])

    def hold(self, pads: Array, springs: Array) -> "HeldShell":
        """The panel on springs at pads (P, 2); springs (P, 3) in N/mm along u, v, w."""
        C = self.at(pads)
        k = sp.diags(springs.ravel())
        return HeldShell(self, C, springs.ravel(), splu((self.stiffness + C.T @ k @ C).tocsc()))


@dataclass(frozen=True)
class HeldShell:
    """Displacements for given motions of the springs' far ends."""

    shell: Shell
    at_pads: sp.csr_matrix
    springs: Array  # (3P,)
    solver: object

    def response(self, ends: Array) -> Array:
        """Unknowns (3·size, K) for motions (3P, K) of the springs' far ends."""
        return np.asarray(self.solver.solve(np.asarray(self.at_pads.T @ (self.springs[:, None] * ends))))  # type: ignore[attr-defined]

    def sag(self, load: Array) -> Array:
        """Unknowns (3·size,) under a load with the far ends held."""
        return np.asarray(self.solver.solve(load))  # type: ignore[attr-defined]

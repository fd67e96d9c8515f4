"""The source's solution: project the polyhedron of points and origins onto X-Y, X-Z and Y-Z (formulas 5 to 11).

The X-Y plane is solved by the cosine rule, letter for letter but for two misprints: |O2R2| is printed with the
coordinates of R1, and |O1e| with |O1P1| where its triangle has the side |O1P2|. Both pairs are equal in the
source's experiments. The source's γ counts clockwise; `project` returns right-handed angles, so its γ is −γz.

For X-Z and Y-Z the source says only "likewise". With the cosine rule that is 0/0 for its own experiments, where P1
and P2 fall on one point of the X-Z plane. Here each of these planes is solved from the vectors R1R2 that rod and
second robot give, which is the same triangle; an angle whose R1R2 falls on a point of its plane is taken as level.
"""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.cells.base_to_base.stand import Stand, level_stand, rod_points
from stitch.errors import NoResultError
from stitch.frames import Array

# The formulas hold for the source's arrangement only, and elsewhere give any number without a sign of it. So the
# solution must carry R1 and R2 onto the rod's cup within this share of the rod's length: far above all noise.
_GAP = 0.05
# R1R2 shorter in a plane than this share of its length gives no angle there.
_SHORT = 0.05
_ARRANGEMENT = "rod and joints contradict each other, or the stand is not placed as the source places it"


@dataclass(frozen=True)
class Projection:
    """What the three planes give; angles in rad, right-handed; NaN where a plane shows no angle."""

    T_base1_base2: Array  # (4, 4), formula 11
    gamma_beta_alpha: Array  # (3,)
    offsets: Array  # (3, 2): px1, py1; px2, pz1; py2, pz2


def project(stand: Stand) -> Projection:
    """T_base1_base2 from exactly two points per robot by the source's three projections.

    Raises:
        NoResultError: other than two points per robot, a slide that moved between R1 and R2, or triangles that do
            not close as in the source's arrangement.
    """
    if len(stand.rail.points) != 2 or len(stand.rod.points) != 2 or np.ptp(stand.slide) > 0:
        raise NoResultError(
            "the projection takes two points per robot and one slide; the least squares takes any number"
        )
    R_base1 = frames.transform(level_stand(stand.rail.points, stand.rail_slide), _measured_rod_points(stand))
    gamma, p_xy = _plane_xy(stand)
    turned = stand.rod.points @ _rotation(2, gamma).T
    beta, p_xz = _plane(R_base1, turned, (2, 0), 1)
    turned = stand.rod.points @ (_rotation(2, gamma) @ _rotation(1, _level(beta))).T
    alpha, p_zy = _plane(R_base1, turned, (1, 2), 0)
    rotation = _rotation(2, gamma) @ _rotation(1, _level(beta)) @ _rotation(0, _level(alpha))
    offsets = np.array([p_xy, p_xz[::-1], p_zy])
    mean = [(p_xy[0] + p_xz[1]) / 2, (p_xy[1] + p_zy[0]) / 2, (p_xz[0] + p_zy[1]) / 2]
    T = frames.make(rotation, np.array(mean))
    gap = float(np.linalg.norm(frames.transform(T, stand.rod.points) - R_base1, axis=1).max())
    if not gap < _GAP * stand.length.max():
        raise NoResultError(f"the projection misses the rod's cup by {gap:.3g}; {_ARRANGEMENT}")
    return Projection(T, np.array([gamma, beta, alpha]), offsets)


def _plane_xy(stand: Stand) -> tuple[float, Array]:
    """γ and (px1, py1) by formulas 5 to 10 and the cosine rules after them.

    Written for the source's side: seen from above, the rod turns clockwise. The other side is its mirror image.
    """
    mirror = np.array([1.0, stand.turn, 1.0])
    P, R = stand.rail.points * mirror, stand.rod.points * mirror
    rod, theta = _projected_rod(P, stand.angle, stand.length)
    P2e = (stand.slide[0] - stand.rail_slide[1]) * np.cos(_slope(P))
    Pr, Rr = np.arctan2(P[:, 1], P[:, 0]), -np.arctan2(R[:, 1], R[:, 0])
    O1P, O2R = np.hypot(P[:, 0], P[:, 1]), np.hypot(R[:, 0], R[:, 1])
    P1P2, R1R2 = _third_side(O1P[0], O1P[1], abs(Pr[0] - Pr[1])), _third_side(O2R[0], O2R[1], abs(Rr[0] - Rr[1]))
    C1, C3 = _angle(O1P[0], P1P2, O1P[1]), _angle(O2R[0], R1R2, O2R[1])
    C2, C4, C7 = np.pi - (C1 + Pr[0]), np.pi - (C3 + Rr[0]), np.pi - (C3 + abs(Rr[0] - Rr[1]))
    C5, C6 = _angle(rod[0], R1R2, rod[1]), _angle(R1R2, rod[1], rod[0])
    gamma_z = C2 + C4 + theta[0] - C5
    O2e = _third_side(O2R[1], rod[1], C7 + C6)
    C8 = _angle(O2e, rod[1], O2R[1])
    C13 = C1 + abs(Pr[0] - Pr[1])
    O1e = _third_side(P2e, O1P[1], C13)
    C10 = _angle(P2e, O1e, O1P[1])
    side = np.sign(Pr[1])
    er = side * (np.pi - (C13 + C10)) + Pr[1]
    C9 = C10 + theta[1] - C8
    O1O2 = _third_side(O2e, O1e, C9)
    C11 = _angle(O1O2, O1e, O2e)
    bearing = side * (abs(er) - C11)
    gamma = float(np.arctan2(np.sin(-gamma_z), np.cos(-gamma_z))) * stand.turn
    return gamma, O1O2 * np.array([np.cos(bearing), stand.turn * np.sin(bearing)])


def _projected_rod(P: Array, angle: Array, length: Array) -> tuple[Array, Array]:
    """Length and angle of the rod in the X-Y plane, formulas 5 to 10."""
    RS, ES = length * np.sin(angle), length * np.cos(angle)
    DE = ES * np.cos(_slope(P))
    return np.hypot(RS, DE), np.arctan2(RS, DE)


def _slope(P: Array) -> float:
    """Angle of P1P2 against the X-Y plane, formula 7."""
    return float(np.arctan2(P[0, 2] - P[1, 2], np.hypot(P[0, 0] - P[1, 0], P[0, 1] - P[1, 1])))


def _third_side(a: float, b: float, between: float) -> float:
    return float(np.sqrt(a * a + b * b - 2 * a * b * np.cos(between)))


def _angle(a: float, b: float, opposite: float) -> float:
    """Angle between the sides a and b of a triangle."""
    cosine = (a * a + b * b - opposite * opposite) / (2 * a * b) if a * b > 0 else np.nan
    # A triangle that lies flat may miss ±1 by rounding; one that misses more does not close.
    if not abs(cosine) < 1 + 1e-12:
        raise NoResultError(f"projection: sides {a:.4f}, {b:.4f} and {opposite:.4f} make no triangle; {_ARRANGEMENT}")
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _plane(R_base1: Array, R_turned: Array, axes: tuple[int, int], normal: int) -> tuple[float, Array]:
    """Angle about the axis `normal` and the two offsets, from the direction of R1R2 in the plane `axes`."""
    here, there = R_base1[:, axes], R_turned[:, axes]
    d1, d2 = here[1] - here[0], there[1] - there[0]
    seen = np.linalg.norm(d2) > _SHORT * np.linalg.norm(R_turned[1] - R_turned[0])
    angle = float(np.arctan2(d2[0] * d1[1] - d2[1] * d1[0], d2 @ d1)) if seen else float("nan")
    turned = R_turned @ _rotation(normal, _level(angle)).T
    return angle, np.asarray((R_base1 - turned).mean(axis=0)[list(axes)])


def _level(angle: float) -> float:
    return 0.0 if np.isnan(angle) else angle


def _rotation(axis: int, angle: float) -> Array:
    return np.asarray(frames.exp(np.concatenate([angle * np.eye(3)[axis], np.zeros(3)]))[:3, :3])


def _measured_rod_points(stand: Stand) -> Array:
    return rod_points(stand.slide, stand.angle, stand.length, stand.turn)

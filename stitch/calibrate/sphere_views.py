"""Each scan of the known sphere on its own: where the centre can be, in the scanner frame.

A laser line on the sphere is a circle of radius ρ; the centre lies √(R² − ρ²) off the laser plane, to
one side or the other. The sense of the arc gives the plane's normal a sign that a person can name: the
cross product of the vectors through its upper, middle and lower points in the order of the file, the
same for every line of one scanner. It cannot say on which side of the plane the sphere lies.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.detection.ball import fit_ball
from stitch.errors import InputError
from stitch.frames import Array

# Points whose rms distance from a plane is below this share of their extent are a laser line.
_FLAT = 1e-3
# A circle may come out larger than the sphere by noise, not by this share.
_TOO_LARGE = 0.05
_FEWEST = 20
# A surface whose own radius is this much off the sphere's is something else.
_OTHER = 0.2


@dataclass(frozen=True)
class SphereView:
    """One scan; lengths in length_unit, all in the scanner frame."""

    name: str
    points: Array  # (N, 3) of the sphere, outliers taken out
    dropped: int  # points taken out
    foot: Array  # (3,) centre of the sphere (area scan) or of the circle (laser line)
    normal: Array  # (3,) of the laser plane; zero for an area scan
    offset: float  # distance of the centre from the laser plane; zero for an area scan
    sigma: float  # robust sigma of the points about the circle or the sphere, free in this view
    side: float  # +1, -1: the session says where along the normal; 0: it does not
    directions: Array  # (k, 3) in which the centre is measured: in the laser plane (k = 2) or all (k = 3)
    measured: Array  # (k + 1,) centre along these directions, and radius of the circle or sphere, all free
    covariance: Array  # (k + 1, k + 1) of `measured` from the points' sigma

    @property
    def is_line(self) -> bool:
        """True for a laser line, False for an area scan."""
        return bool(self.normal.any())


def sphere_view(name: str, points: Array, radius: float, side: float = 0.0) -> SphereView:
    """Fit one scan (N, 3).

    Raises:
        InputError: too few points, or a circle larger than the sphere.
    """
    if len(points) < _FEWEST:
        raise InputError(f"view {name}: {len(points)} points on the sphere are too few; leave the view out")
    middle = points.mean(axis=0)
    _U, s, Vt = np.linalg.svd(points - middle, full_matrices=False)
    if s[2] > _FLAT * s[0]:
        return _area(name, points, radius)
    circle = fit_ball((points - middle) @ Vt[:2].T, radius)
    if circle.radius > (1 + _TOO_LARGE) * radius:
        raise InputError(
            f"view {name}: the line is a circle of radius {circle.radius:.4g}, larger than the sphere's {radius:.4g}; "
            "check sphere.radius in session.toml and cloud_unit"
        )
    kept = points[circle.keep]
    return SphereView(
        name=name,
        points=kept,
        dropped=int((~circle.keep).sum()),
        foot=middle + circle.centre @ Vt[:2],
        normal=arc_normal(kept, Vt[2]),
        offset=float(np.sqrt(max(radius**2 - circle.radius**2, 0.0))),
        sigma=circle.sigma,
        side=float(np.sign(side)),
        directions=Vt[:2],
        measured=np.append(circle.centre + Vt[:2] @ middle, circle.radius),
        covariance=circle.covariance,
    )


def _area(name: str, points: Array, radius: float) -> SphereView:
    """The centre with the known radius starts the search; centre and radius, both free, are what is measured."""
    known = fit_ball(points, radius, known=True)
    kept = points[known.keep]
    free = fit_ball(kept, radius) if len(kept) >= _FEWEST else known
    if len(kept) < _FEWEST or not 1 - _OTHER < free.radius / radius < 1 + _OTHER:
        raise InputError(
            f"view {name}: no sphere of radius {radius:.4g} among its points (the best has {free.radius:.4g}); check "
            "sphere.radius in session.toml and cloud_unit, or leave the view out"
        )
    return SphereView(
        name=name,
        points=kept,
        dropped=int((~known.keep).sum()),
        foot=known.centre,
        normal=np.zeros(3),
        offset=0.0,
        sigma=free.sigma,
        side=0.0,
        directions=np.eye(3),
        measured=np.append(free.centre, free.radius),
        covariance=free.covariance,
    )


def arc_normal(arc: Array, normal: Array) -> Array:
    """The plane's unit normal (3,), signed by the sense in which the arc (N, 3) is run through."""
    third = max(1, len(arc) // 3)
    upper, middle, lower = arc[:third].mean(axis=0), arc[third:-third].mean(axis=0), arc[-third:].mean(axis=0)
    return np.asarray(normal * (np.sign(np.cross(middle - upper, lower - middle) @ normal) or 1.0))


def centres(views: Sequence[SphereView], signs: Array) -> Array:
    """Centres (V, 3) of the sphere in the scanner frame for one choice of sides (V,)."""
    return np.array([v.foot + s * v.offset * v.normal for v, s in zip(views, signs, strict=True)])

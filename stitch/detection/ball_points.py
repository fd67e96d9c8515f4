"""Centres of balls as labelled points: found in every view, checked against the radius, told apart over all views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.detection.ball import Ball, refine_ball
from stitch.detection.ball_labels import ViewBalls, label_balls
from stitch.detection.balls import find_balls
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.labelled_points import Sighting
from stitch.system.threads import parallel

# A radius belongs to the one stated within this share, and within so many sigmas.
_STATED_RADIUS_SHARE, _STATED_RADIUS_SIGMAS = 0.02, 4.0
# Radii around the stated ones that are looked at first.
_AROUND = 1.5


@dataclass(frozen=True)
class _AgreedBall:
    """One ball of one view, with the radius that all views agree on."""

    ball: Ball
    radius: float
    scatter: float  # of the radius over the views, beyond what a view's own points explain


def ball_sightings(
    clouds: Sequence[Array | None], rotations: Sequence[Array | None], stated: Sequence[float], to_mm: float
) -> tuple[list[Sighting], list[str]]:
    """Centres of the balls in every view.

    Args:
        clouds: (N, 3) a view, scanner frame; None for a view without a scan.
        rotations: (3, 3) R_base_flange a view, where it is known.
        stated: radii, in the unit of the clouds; none for balls of any radius.
        to_mm: millimetres per unit, for messages.

    Returns:
        A sighting a view, empty where no ball is seen or told apart, and what was left out, in words.

    Raises:
        InputError: balls of another radius than stated; names the one found.
    """
    seen = _find_all_balls(clouds, stated)
    if stated and any(seen):
        kept = [[ball for ball in view if _stated_radius(ball, stated) is not None] for view in seen]
        if not any(kept):
            raise _radius_error(seen, stated, to_mm)
        seen = kept
    agreed = _agree_on_radius(clouds, seen, stated)
    views = [_view_balls(balls, R) for balls, R in zip(agreed, rotations, strict=True)]
    labels = label_balls(views)
    nameless = sum(name is None for names in labels for name in names)
    notes = [_nameless_note(labels, nameless)] if nameless else []
    return [_ball_sighting(view, names) for view, names in zip(views, labels, strict=True)], notes


def _find_all_balls(clouds: Sequence[Array | None], stated: Sequence[float]) -> list[list[Ball]]:
    """Balls of every view, near the radii stated; of any radius where there are none."""
    limits = (min(stated) / _AROUND, max(stated) * _AROUND) if stated else (0.0, float("inf"))
    found = list(parallel(lambda cloud: [] if cloud is None else find_balls(cloud, limits), clouds))
    if any(found) or not stated:
        return found
    return list(parallel(lambda cloud: [] if cloud is None else find_balls(cloud), clouds))


def _sigma_of_radius(ball: Ball) -> float:
    return float(np.sqrt(ball.covariance[-1, -1]))


def _sigma_of_centre(ball: Ball) -> float:
    """Of a coordinate, where the radius is known."""
    C = ball.covariance
    known = C[:3, :3] - np.outer(C[:3, 3], C[3, :3]) / C[3, 3]
    return float(np.sqrt(max(np.trace(known) / 3, 0.0)))


def _stated_radius(ball: Ball, stated: Sequence[float]) -> float | None:
    nearest = min(stated, key=lambda radius: abs(radius - ball.radius))
    room = max(_STATED_RADIUS_SHARE * nearest, _STATED_RADIUS_SIGMAS * _sigma_of_radius(ball))
    return nearest if abs(ball.radius - nearest) <= room else None


def _radius_error(balls: Sequence[Sequence[Ball]], stated: Sequence[float], to_mm: float) -> InputError:
    """A refusal that names the radius seen most."""
    radii = np.sort([ball.radius for view in balls for ball in view])
    groups = np.split(radii, np.flatnonzero(np.diff(radii) > 2 * _STATED_RADIUS_SHARE * radii[1:]) + 1)
    group = max(groups, key=len)
    found, views = float(np.median(group)) * to_mm, sum(any(b.radius in group for b in view) for view in balls)
    told = ", ".join(f"{radius * to_mm:g}" for radius in stated)
    return InputError(
        f"--ball {told}: no ball of this radius; balls of {found:.2f} mm are seen in {views} view{'s' * (views > 1)}; "
        f"to fix: state --ball {found:.2f} or --ball any, or correct cloud_unit in session.toml"
    )


def _agree_on_radius(
    clouds: Sequence[Array | None], balls: Sequence[Sequence[Ball]], stated: Sequence[float]
) -> list[list[_AgreedBall]]:
    """The balls fitted anew with one radius for each size: the one stated, or the mean over the views."""
    every = [ball for view in balls for ball in view]
    radii = np.array([ball.radius for ball in every])
    out = []
    for cloud, view in zip(clouds, balls, strict=True):
        own = []
        for ball in view:
            alike = np.abs(radii - ball.radius) <= _STATED_RADIUS_SHARE * ball.radius
            said = _stated_radius(ball, stated) if stated else None
            radius = said if said is not None else float(np.median(radii[alike]))
            noise = float(np.mean([_sigma_of_radius(b) ** 2 for b, same in zip(every, alike, strict=True) if same]))
            spread = float(np.mean((radii[alike] - radius) ** 2))
            assert cloud is not None
            local = cloud[np.linalg.norm(cloud - ball.centre, axis=1) < 1.3 * radius]
            fitted = refine_ball(local, ball.centre, ball.radius, known=radius)
            own.append(_AgreedBall(fitted, radius, float(np.sqrt(max(spread - noise, 0.0)))))
        out.append(own)
    return out


def _view_balls(balls: Sequence[_AgreedBall], R_flange: Array | None) -> ViewBalls:
    """A radius that differs from view to view is an error of the scanner: the centre has one of that size too."""
    sigma = [np.hypot(_sigma_of_centre(s.ball), s.scatter) for s in balls]
    centres = np.array([s.ball.centre for s in balls]).reshape(-1, 3)
    return ViewBalls(centres, np.array(sigma), np.array([s.radius for s in balls]), R_flange)


def _ball_sighting(view: ViewBalls, names: Sequence[int | None]) -> Sighting:
    told = np.array([name is not None for name in names], bool)
    words = tuple(f"ball{name + 1}" for name in names if name is not None)
    return Sighting(words, view.centres[told], view.sigma[told])


def _nameless_note(labels: Sequence[Sequence[int | None]], nameless: int) -> str:
    views = sum(any(name is None for name in names) for names in labels)
    return (
        f"{nameless} balls in {views} views cannot be told from others of their size and are left out; three or more a "
        "view at distances that all differ, or balls of different sizes, can"
    )

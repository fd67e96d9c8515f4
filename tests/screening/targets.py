"""Labelled points whose every place is known, as views from anywhere show them."""

from dataclasses import replace

import numpy as np

from data_synth.fixtures.in_memory import session_of
from stitch.numerics import frames
from stitch.session.capture import Sightings
from stitch.session.session import Sighting

VIEWS, SIGMA = 14, 0.01
PLACES = np.array([[0, 0, 0], [120, 10, 0], [0, 90, 30], [80, 70, -20], [40, -60, 50.0]])


def with_corners(measured, names=None):
    """The session of a cell with clouds and four targets on its part, a to d, in some views by other names."""
    corners = np.array([[0.0, 0, 0], [40, 0, 0], [0, 40, 0], [0, 0, 40]])
    corners = frames.transform(measured.T_reference_scanner[0], measured.clouds[0].points.mean(axis=0) + corners)
    session, rng, views = session_of(measured), np.random.default_rng(3), []
    for v, T in enumerate(measured.T_reference_scanner):
        seen = frames.transform(frames.inverse(T), corners) + 0.01 * rng.standard_normal(corners.shape)
        called = tuple((names or {}).get(v, "abcd"))
        views.append(replace(session.views[v], sighting=Sighting(called, seen, np.full(4, 0.01))))
    return replace(session, views=tuple(views))


def sightings(places, seed=0, unseen=()):
    """What views show of targets at places (V, K, 3), but for some pairs of view and target."""
    rng = np.random.default_rng(seed)
    views, count = places.shape[:2]
    turned = frames.exp(rng.normal(size=(views, 6)) * np.repeat([1.0, 100.0], 3))
    points = np.array([frames.transform(T, own) for T, own in zip(turned, places, strict=True)])
    target = np.tile(np.arange(count), (views, 1))
    for view, k in unseen:
        target[view, k] = -1
    points = points + SIGMA * rng.normal(size=points.shape)
    names = tuple(f"ball{k + 1}" for k in range(count))
    return Sightings(names, target, points, np.full(target.shape, SIGMA), target >= 0)

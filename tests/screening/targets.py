"""Labelled points whose every place is known, as views from anywhere show them."""

import numpy as np

from stitch.numerics import frames
from stitch.session.capture import Sightings

VIEWS, SIGMA = 14, 0.01
PLACES = np.array([[0, 0, 0], [120, 10, 0], [0, 90, 30], [80, 70, -20], [40, -60, 50.0]])


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

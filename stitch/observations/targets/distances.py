"""Distances between the targets of one view: what they are wherever the arm stood, whatever the hand-eye is."""

import numpy as np

from stitch.frames import Array
from stitch.measurement.sightings import Sightings

# More targets hold each other, so that a wrong one pulls little; to compare all their pairs takes minutes.
COMPARED_TARGETS = 24


def target_positions(sightings: Sightings) -> Array:
    """(V, K, 3) targets in the frame of the sensor, NaN where a view does not show one."""
    places = np.full((len(sightings.target), len(sightings.targets), 3), np.nan)
    view, slot = np.nonzero(sightings.used)
    places[view, sightings.target[view, slot]] = sightings.points[view, slot]
    return places


def target_distances(places: Array) -> Array:
    """(V, K, K) between targets, NaN where a view does not show both."""
    return np.asarray(np.linalg.norm(places[:, :, None] - places[:, None], axis=3))


def distance_sigma(sightings: Sightings) -> float:
    """What the noise of two coordinates leaves of a distance, length_unit."""
    return float(np.sqrt(2) * np.median(sightings.sigma[sightings.used]))

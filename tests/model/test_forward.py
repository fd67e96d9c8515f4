"""Slopes of poses and points against differences and against nature."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need, parameters_in
from stitch.model.forward import PointSlopes, perturbed_frames, pose_derivatives
from stitch.model.model import Model, Term, term_of
from stitch.numerics import frames
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of, with_part_origin


def chain_for(measured):
    session = session_of(measured)
    return measurement_of(session, prepare_capture(session))


MOVING = [n for n, e in EFFECTS.items() if e.place in ("base", "robot", "links", "mount", "part")]
# What the arm must carry to give way under its weight; the base stands left of the hand-eye on either.
CARRIED = ("mount_droop", "mount_bend")


@pytest.mark.parametrize(
    ("name", "mount"),
    [
        *((n, "eye_to_hand") for n in MOVING if n not in CARRIED),
        *((n, "eye_in_hand") for n in (*CARRIED, "base_compliance")),
    ],
)
def test_twists_are_the_derivative_of_the_poses(still_cells, name, mount):
    """Central differences of half the size about the same place, by another route: a point carried along."""
    measurement = with_part_origin(chain_for(still_cells[mount]), still_cells[mount].T_mount)
    effect = EFFECTS[name]
    if missing_need(measurement, effect):
        pytest.skip(f"needs {missing_need(measurement, effect)}")
    parameters = parameters_in(measurement, effect)
    # A twist that is zero hides its time constant: begin where it is not.
    values = np.array([p.grid[0] if p.grid else 0.3 * p.typical for p in parameters])
    T = still_cells[mount].T_mount
    centre = np.array([5.0, -3.0, 80.0])
    (slopes,) = pose_derivatives(measurement, Model(T), [term_of(measurement, effect).at(values)], centre)
    point = np.array([10.0, 20.0, 120.0])
    for i, parameter in enumerate(parameters):
        if parameter.discrete:
            assert not slopes[i].any()
            continue
        h = (0.001 if parameter.grid else 0.01) * parameter.typical
        carried = []
        for sign in (1, -1):
            left, right = perturbed_frames(
                measurement, [term_of(measurement, effect).at(values + sign * h * np.eye(len(values))[i])]
            )
            left0, right0 = perturbed_frames(measurement, [term_of(measurement, effect).at(values)])
            carried.append(frames.transform(left @ T @ right @ frames.inverse(left0 @ T @ right0), point[None])[:, 0])
        expected = (carried[0] - carried[1]) / (2 * h)
        predicted = slopes[i][:, 3:] + np.cross(slopes[i][:, :3], point - centre)
        # At the plausible size, within two parts in a thousand and a nanometre.
        off = np.abs(predicted - expected).max() * parameter.typical
        assert off < 2e-3 * np.abs(expected).max() * parameter.typical + 1e-6


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.place in ("sensor", "shape")])
def test_point_slopes_are_minus_what_nature_does(still_cells, name):
    """To first order the correction is the negative of the effect itself."""
    measured = still_cells["eye_to_hand"]
    measurement = chain_for(measured)
    effect = EFFECTS[name]
    pose = measured.T_reference_scanner[2]
    index = np.arange(0, 200, 7)
    zero = Term(effect, parameters_in(measurement, effect))
    slopes = PointSlopes(measurement, [zero], Model(np.eye(4))).at(2, pose, index)
    view = measurement.scan_views[2]
    view = replace(view, cosine=view.cosine[index], intensity=view.intensity[index])
    points = measurement.capture.scans[2].points[index]
    at = frames.transform(pose, points) if effect.place == "shape" else points
    for i, parameter in enumerate(parameters_in(measurement, effect)):
        h = 1e-3 * parameter.typical
        values = h * np.eye(len(slopes))[i]
        moved = (effect.function(at, view, **zero.at(values).arguments) - at) / h
        expected = -frames.rotate(frames.inverse(pose), moved) if effect.place == "shape" else -moved
        assert np.allclose(slopes[i], expected, rtol=1e-2, atol=1e-6 * np.abs(expected).max())

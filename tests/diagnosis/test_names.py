"""Names hold against what arms do that no library has; and what has no name is said to have none."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.ordinary_arm import with_memory
from stitch import frames
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import concluded
from stitch.diagnosis.plausible_scatter import ScatterLimit
from stitch.diagnosis.thresholds import IMPLAUSIBLE
from stitch.effects.contract import EFFECTS
from stitch.measurement.measurement import measurement_of
from stitch.model.model import Model
from stitch.observations.surfaces.free_poses import free_poses
from stitch.observations.surfaces.surface_model import surface_model

# Effects that move views as wholes; those of points take longer to ask for.
ASKED = (
    *(
        "joint_offset",
        "link_geometry",
        "joint_compliance",
        "gear_eccentricity",
        "gear_harmonic",
        "backlash",
        "settling",
    ),
    *("robot_thermal_growth", "mount_drift", "fixture_drift"),
)


@pytest.fixture(scope="module")
def cell():
    """A blade on the flange and its freed views under the true hand-eye."""
    measured = measured_blade(4, views=14, pixels=60)
    capture = captured(measured)
    return (
        measured,
        measurement_of(session_of(measured), capture),
        free_poses(capture, capture.poses(measured.T_mount), 1.0),
    )


def said_of(cell, T_base_flange):
    """Verdict and linear model where the flange truly is there."""
    measured, measurement, freed = cell
    to_centre = frames.make(np.eye(3), -freed.overlaps.gram.centre)
    model = measurement.capture.poses(measured.T_mount)
    moved = frames.log(to_centre @ frames.inverse(T_base_flange) @ measured.T_mount @ frames.inverse(to_centre @ model))
    seen = replace(freed, twists=freed.twists + moved)
    linear = surface_model(measurement, Model(measured.T_mount), measurement.capture, seen)
    candidates = [c for name in ASKED if (c := candidate_of(linear, EFFECTS[name])) is not None]
    return concluded(linear, candidates, ScatterLimit(*IMPLAUSIBLE)), linear


def test_an_offset_of_one_joint_is_named(cell):
    measured, *_ = cell
    q = measured.plan.joints + np.array([0, 0, 0, 1.5e-3, 0, 0])
    found, _ = said_of(cell, kinematics.flange(measured.plan.arm, q))
    assert found.verdict in ("missing_effect", "cannot_tell")
    assert "joint_offset" in [r.name for r in found.named]


def test_poses_that_wander_get_no_name(cell):
    """0.6 mm and 0.6 mrad that every view hands on to the next: no drift, no settling, no growth."""
    measured, *_ = cell
    for seed in range(2):
        wander = with_memory(14, 0.9, np.random.default_rng(seed)) * np.repeat([6e-4, 0.6], 3)
        found, _ = said_of(cell, measured.T_base_flange @ frames.exp(wander))
        assert found.verdict == "unknown_effect" and not found.named

"""Effects of the model undo nature's laws, which share no code with them."""

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.effects import EFFECTS
from stitch.effects.contract import parameters_in
from stitch.model.forward import corrected_capture, perturbed_frames
from stitch.model.model import Model, term_of
from stitch.numerics import frames
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

# Amplitude 1 is a tenth of a millimetre; a hundredth of that must remain: second-order terms are smaller still.
_LEFT = 0.03


def chain_for(measured):
    session = session_of(measured)
    return measurement_of(session, prepare_capture(session))


def hidden(name, mount):
    return measured_blade(0, views=4, mount=mount, repeatability=(0.0, 0.0), pixels=40, hidden={name: 1.0}, noise=0.0)


RIGID = [
    "mount_drift", "mount_warmup", "joint_offset", "link_geometry", "joint_compliance", "gear_eccentricity",
    "gear_harmonic", "backlash", "settling", "robot_thermal_growth",
]  # fmt: skip


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("name", RIGID)
def test_undoing_an_effect_gives_natures_poses(still_cells, name, mount):
    """The model with nature's own parameters places every view where it truly was."""
    measured = hidden(name, mount)
    measurement = chain_for(measured)
    told = measured.hidden[name]
    effect = EFFECTS[name]
    values = np.array([told.get(p.name, 0.0) for p in parameters_in(measurement, effect)])
    left, right = perturbed_frames(measurement, [term_of(measurement, effect).at(values)])
    poses = left @ measured.T_mount @ right
    plain, still = perturbed_frames(measurement, [])
    middle = np.array([[0.0, 0.0, 420.0]])
    truth = frames.transform(measured.T_reference_scanner, middle)
    off = np.linalg.norm(frames.transform(poses, middle) - truth, axis=-1).max()
    before = np.linalg.norm(frames.transform(plain @ measured.T_mount @ still, middle) - truth, axis=-1).max()
    assert before > 0.01
    assert off < 1e-6


@pytest.mark.parametrize(
    "name", ["range_scale", "range_nonlinearity", "field_curvature", "lens_distortion", "scanner_thermal_scale"]
)
def test_undoing_a_scanner_effect_gives_the_true_points(name):
    """Same seed with and without: the corrected points are those of the cell without the effect."""
    plain, bent = hidden_pair(name, "eye_to_hand")
    measurement = chain_for(bent)
    effect = EFFECTS[name]
    values = np.array([bent.hidden[name][p.name] for p in parameters_in(measurement, effect)])
    mended = corrected_capture(measurement, Model(bent.T_mount, (term_of(measurement, effect).at(values),)))
    for scan, true, wrong in zip(mended.scans, plain.clouds, bent.clouds, strict=True):
        before = np.abs(wrong.points - true.points).max()
        assert np.abs(scan.points - true.points).max() <= _LEFT * before + 1e-9


def hidden_pair(name, mount):
    common = {"views": 3, "mount": mount, "repeatability": (0.0, 0.0), "pixels": 50}
    return measured_blade(2, **common), measured_blade(2, hidden={name: 1.0}, **common)

"""Errors that repeat in every view: how large they are, and what they do to the hand-eye's sigmas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import Measured, simulated
from data_synth.scene import load_scene
from stitch.api import pipeline
from stitch.diagnosis.diagnose import linear_model_of
from stitch.numerics import frames
from stitch.observations.surfaces.field_error import field_error
from stitch.observations.surfaces.scanner_errors import field_scatter

SEEDS = 2


def repeated(share: float, seed: int) -> Measured:
    """A plate seen by a scanner of which smooth errors of `share` of the noise repeat."""
    scene = load_scene("drill-plate")
    scanner = replace(scene.scanner, columns=50, rows=50, field_error=share * scene.scanner.noise)
    return simulated(replace(scene, scanner=scanner, repeatability=(4e-6, 0.004)), {}, seed, views=10)


def chi_squares(share: float) -> tuple[list[float], list[float]]:
    """Per seed χ² of the hand-eye's error and the sigma of its place (mm); smooth errors of `share` of the noise."""
    squares, sigmas = [], []
    for seed in range(SEEDS):
        measured = repeated(share, seed)
        found = pipeline.run(session_of(measured))
        xi = frames.log(frames.inverse(found.T_mount) @ measured.T_mount)
        squares.append(float(xi @ np.linalg.solve(found.mount_covariance, xi)))
        sigmas.append(float(np.sqrt(np.trace(found.mount_covariance[3:, 3:]))))
    return squares, sigmas


@pytest.mark.parametrize(
    ("share", "unusual", "over_noise"),
    [
        pytest.param(0.2, False, False, marks=pytest.mark.slow),
        (0.9, True, False),
        pytest.param(4.0, True, True, marks=pytest.mark.slow),
    ],
)
def test_what_repeats_is_told_with_its_size(share, unusual, over_noise):
    """A usual scanner, one that errs by nearly its noise, and one by four times that: none too much is said of any."""
    measured = repeated(share, 0)
    linear = linear_model_of(pipeline.run(session_of(measured)))
    found = field_error(linear.measurement, linear.model, linear.observation.unconstrained, 0.01)
    assert (found.unusual, found.over_noise) == (unusual, over_noise)
    assert found.rms < 2 * share * load_scene("drill-plate").scanner.noise
    assert not unusual or found.rms > 0.3 * share * load_scene("drill-plate").scanner.noise


@pytest.mark.slow
def test_sigmas_hold_whatever_the_scanner_repeats():
    """As large as the noise, or none: the error is within its covariance, and small errors do not widen it as large."""
    large, small = chi_squares(1.0), chi_squares(0.0)
    for squares, _ in (large, small):
        assert sum(squares) < chi2.ppf(0.999, 6 * SEEDS)
    assert np.mean(large[1]) > 1.5 * np.mean(small[1])


@pytest.mark.slow
def test_what_incidence_shows_is_not_laid_on_the_field():
    """A carried scanner on a coarse surface: grazing points pretend a bias, while its field has no error at all."""
    scene = load_scene("blade-table")
    scanner = replace(scene.scanner, columns=80, rows=80, field_error=0.0)
    measured = simulated(replace(scene, scanner=scanner), {}, 3, views=10)
    linear = linear_model_of(pipeline.run(session_of(measured)))
    shown, unit = (field_scatter(linear.measurement, linear.observation.unconstrained, share) for share in (None, 1.0))
    shares = np.linalg.norm(shown, axis=0) / np.linalg.norm(unit, axis=0)
    assert np.max(shares[:-1]) < 0.2

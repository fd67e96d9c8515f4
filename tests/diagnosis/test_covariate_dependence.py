"""Which covariates are joints."""

from dataclasses import replace

import numpy as np

from data_synth.fixtures.in_memory import session_of
from stitch.diagnosis.residual_structure import covariate_values
from stitch.session.measurement import measurement_of


def test_what_a_covariate_is_called_does_not_make_it_a_joint(blade_capture):
    measured, capture = blade_capture
    tilt = np.arange(5.0)
    views = replace(
        measurement_of(session_of(measured), capture).views, covariates={"jig_deg": tilt, "j_deg": 2 * tilt}
    )
    assert np.array_equal(covariate_values(views, "jig_deg"), tilt) and np.array_equal(
        covariate_values(views, "j_deg"), 2 * tilt
    )
    assert np.allclose(covariate_values(views, "j2_deg"), np.degrees(measured.plan.joints[:, 1]))

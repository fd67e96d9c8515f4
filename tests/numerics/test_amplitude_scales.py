"""Priors of amplitudes with a tail, against densities by scipy."""

import numpy as np
import pytest
from scipy.stats import norm

from stitch.numerics.parameter_selection import ANY_SIZE, PLAUSIBLE, log_mixture


@pytest.mark.parametrize("scales", [PLAUSIBLE, ANY_SIZE])
def test_shares_add_up_to_all(scales):
    assert sum(scales.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("scales", [PLAUSIBLE, ANY_SIZE])
@pytest.mark.parametrize("seen", [0.0, 2.0, 66.0])
def test_the_evidence_is_that_of_the_mixture(scales, seen):
    """One number with sigma 1 of an amplitude that is usually of size 1; one of 66 is seen as well as it is."""
    logs = np.array([norm.logpdf(seen, scale=np.hypot(1.0, scale)) for scale in scales])
    mixture = sum(share * norm.pdf(seen, scale=np.hypot(1.0, scale)) for scale, share in scales.items())
    assert log_mixture(logs, scales) == pytest.approx(np.log(mixture))
    if seen > 60:
        # Under a normal prior of plausible size what is 66 sizes large explains a thousand nats less than it is.
        lost = norm.logpdf(seen, scale=seen) - log_mixture(logs, scales)
        assert lost < 10 < norm.logpdf(seen, scale=seen) - norm.logpdf(seen, scale=np.hypot(1.0, 1.0)) - 500

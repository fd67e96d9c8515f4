"""Whether an effect earned its place, where the held-out residual did not fall."""

from types import SimpleNamespace

import pytest

from stitch.cli.change import remarks


def with_effect(sigmas: float, heldout: float) -> SimpleNamespace:
    """A run to which an effect was added that is so many sigmas from zero, and what it left held out (1.0 before)."""
    parameter = SimpleNamespace(
        name="a", value=sigmas, sigma=1.0, fitted=True, held=False, beyond_belief=lambda value, sigma: False
    )
    steps = (SimpleNamespace(effects=(), heldout_rms=1.0), SimpleNamespace(effects=("settling",), heldout_rms=heldout))
    return SimpleNamespace(
        ledger=steps,
        terms=(SimpleNamespace(name="settling", parameters=(parameter,), sigmas_from_zero=sigmas, is_geometry=False),),
    )


@pytest.mark.parametrize(
    ("sigmas", "heldout", "said"),
    [
        (9.0, 0.5, None),
        (9.0, 1.01, "9 sigmas from zero, but too small"),
        (3.8, 1.01, "did not fall, and the clearest number is 3.8 sigmas"),
        (3.8, 1.2, "residual rose, and"),
        (1.0, 1.01, "did not earn a place"),
    ],
)
def test_a_residual_that_does_not_fall_condemns_only_what_is_not_seen(sigmas, heldout, said):
    told = [line for line in remarks(with_effect(sigmas, heldout)) if "dropped" not in line]
    assert told == [] if said is None else said in told[0]

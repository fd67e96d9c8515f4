"""What a still parameter may follow spans what structures do that lag behind the air."""

import numpy as np

from stitch.plugins.watch.update import chosen_channels, regressor_prior_sigmas, regressors

HOUR = 3600.0


def test_a_delayed_answer_to_an_uneven_day_is_spanned():
    """Newton's law of cooling in closed form: swing cos φ, behind by φ = atan(ωT); the swing changes from day to day."""
    times = np.arange(0.0, 20 * 24, 1.2) * HOUR
    omega, swing = 2 * np.pi / (24 * HOUR), 4 * (1 + 0.3 * np.sin(times / (90 * HOUR)))
    air = swing * np.sin(omega * times)
    names = ["air_temperature_c"]
    X = np.column_stack([np.ones(len(times)), regressors(times, air[:, None], names)])
    assert X.shape[1] == 1 + len(regressor_prior_sigmas(names)) == 5
    for delay in (0.5, 2.0, 6.0):
        phi = np.arctan(omega * delay * HOUR)
        behind = swing * np.cos(phi) * np.sin(omega * times - phi)
        late = slice(40, None)
        without = np.column_stack([X[:, :2], X[:, 3:]])
        left, before = (
            np.std(behind[late] - A[late] @ np.linalg.lstsq(A[late], behind[late], rcond=None)[0]) for A in (X, without)
        )
        assert left < 0.02 * np.std(behind)
        assert left < before / 4


def test_temperatures_come_first_and_gaps_are_held():
    assert chosen_channels(["humidity", "load", "z", "part_temperature_c", "a"]) == [
        "part_temperature_c",
        "a",
        "humidity",
        "load",
    ]
    found = regressors(np.arange(4.0), np.array([[np.nan], [2.0], [np.nan], [3.0]]), ["load"])
    np.testing.assert_allclose(found[:, 0], [0, 2, 2, 3])

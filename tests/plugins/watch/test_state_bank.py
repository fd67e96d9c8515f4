"""The bank against least squares on all sessions at once, and against the dense posterior of a Gaussian process.

What a still parameter may follow spans what structures do that lag behind the air.
"""

import numpy as np
import pytest
from scipy.stats import kstest

from stitch.plugins.watch.state_bank import MEMBERS, empty_bank, predicted_bank, updated_bank, with_parameters
from stitch.plugins.watch.tracking import Sessions, first_state, next_state, smoothed_states
from stitch.plugins.watch.update import chosen_channels, regressor_prior_sigmas, regressors

HOUR = 3600.0


def random_sessions(seed: int, n: int, P: int = 2, steps: float = 0.05) -> Sessions:
    """Errors of one size and either sign: no session is wild, so that all count as they are."""
    rng = np.random.default_rng(seed)
    days = np.cumsum(rng.uniform(0.2, 1.8, n)) * steps
    covariates = np.column_stack([np.sin(days * 2), rng.normal(size=n)])
    sigmas = rng.uniform(0.5, 2.0, (n, P))
    values = 3.0 + covariates @ rng.normal(size=(2, P)) + rng.choice([-1.0, 1.0], (n, P)) * sigmas
    return Sessions(
        list(range(n)), days, values, sigmas, covariates, prior_sigmas=np.full(2, np.inf), channels=["a", "b"]
    )


def test_still_member_is_least_squares_on_all_sessions():
    s = random_sessions(0, 60)
    state = first_state(2)
    for k in range(60):
        state = next_state(state, s, k)
    A = np.column_stack([np.ones(60), s.covariates])
    for p in range(2):
        W = A / s.sigmas[:, p, None]
        x, *_ = np.linalg.lstsq(W, s.values[:, p] / s.sigmas[:, p], rcond=None)
        bank = state.bank
        found = bank.mean[p, 0, [0, 2, 3]] * bank.unit[p] + [bank.origin[p], 0, 0]
        np.testing.assert_allclose(found, x, rtol=1e-5)
        inverse = np.linalg.inv(W.T @ W) / bank.unit[p] ** 2
        np.testing.assert_allclose(bank.covariance[p, 0][np.ix_([0, 2, 3], [0, 2, 3])], inverse, rtol=1e-5)


def test_innovations_are_standard_normal_whatever_share_of_the_sigmas_is_common():
    rng = np.random.default_rng(1)
    n, P = 80, 60
    covariates = np.column_stack([rng.normal(size=n), np.sin(np.arange(n) / 3)])
    values = covariates @ rng.normal(size=(2, P)) * 5 + 0.6 * rng.normal(size=(n, P))
    bank = with_parameters(empty_bank(2, MEMBERS[:1]), values[0], np.ones(P), members=MEMBERS[:1])
    told = []
    for k in range(n):
        bank, u = updated_bank(predicted_bank(bank, 0.05), values[k], np.ones(P), covariates[k])
        told.append(u)
    late = np.array(told[20:]).ravel()
    assert np.isfinite(late).all()
    assert kstest(late, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(late[:-P], late[P:])[0, 1]) < 4 / np.sqrt(len(late))
    assert np.sqrt(bank.scatter).mean() == pytest.approx(0.6, rel=0.03)


@pytest.mark.parametrize("member", range(len(MEMBERS)))
def test_smoother_is_the_dense_posterior(member):
    """Every member as one Gaussian: level and slope as integrals of white noise, their covariances in closed form."""
    n = 25
    s = random_sessions(3, n, P=1, steps=0.4)
    only = (MEMBERS[member],)
    state = first_state(2)
    last = state
    for k in range(n):
        last = next_state(last, s, k)
    likeliest = np.where(np.arange(len(MEMBERS)) == member, 0.0, -1e9)[None]
    last = type(last)(type(last.bank)(**(vars(last.bank) | {"log_likelihood": likeliest})), last.charts, last.day)
    smoothed, own_sigmas = smoothed_states(state, s, {}, last)
    level, start, wander = np.array(only[0]) ** 2
    t = s.days - s.days[0]
    start += wander * s.days[0]  # what the slope has wandered before
    low, high = np.minimum.outer(t, t), np.maximum.outer(t, t)
    # Variance that counts at the first session, and of the integral of an integrated Wiener process (Harvey 1989).
    K = level * low + start * np.outer(t, t) + wander * (low**2 * high / 2 - low**3 / 6)
    unit, origin = s.sigmas[0, 0], s.values[0, 0]
    A = np.column_stack([np.ones(n), s.covariates])
    y, S = (s.values[:, 0] - origin) / unit, K + np.diag((s.sigmas[:, 0] / unit) ** 2)
    # Nothing is believed of level and covariates (Rasmussen & Williams 2006, Gaussian Processes, 2.7).
    B = np.linalg.inv(A.T @ np.linalg.solve(S, A))
    b = B @ A.T @ np.linalg.solve(S, y)
    middle = A @ b + K @ np.linalg.solve(S, y - A @ b)
    np.testing.assert_allclose((smoothed[:, 0] - origin) / unit, middle, atol=2e-6)
    beside = A - K @ np.linalg.solve(S, A)
    variance = np.diag(K - K @ np.linalg.solve(S, K) + beside @ B @ beside.T)
    scatter = last.bank.chosen(np.full(1, member)).scatter[0, 0]
    np.testing.assert_allclose(own_sigmas[:, 0] / unit, np.sqrt(variance * scatter), rtol=1e-5)


def test_process_noise_is_found_by_likelihood():
    rng = np.random.default_rng(5)
    n, P = 250, 4
    for member, (level, _, _) in enumerate(MEMBERS[:4]):
        walk = np.cumsum(rng.normal(size=(n, P)) * level * np.sqrt(0.05), axis=0)
        values = walk + rng.normal(size=(n, P))
        s = Sessions(
            list(range(n)),
            np.arange(n) * 0.05,
            values,
            np.ones((n, P)),
            np.zeros((n, 0)),
            prior_sigmas=np.zeros(0),
            channels=[],
        )
        state = first_state(0)
        for k in range(n):
            state = next_state(state, s, k)
        together = state.bank.log_likelihood[:, :4].sum(axis=0)
        assert abs(int(np.argmax(together)) - member) <= (0 if member > 1 else 1)


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

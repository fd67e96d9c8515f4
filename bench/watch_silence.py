"""False alarms where nothing happens: thousands of cell-months of a thermal cycle and noise."""

import numpy as np
from scipy.stats import chi2

from data_synth.cell_history import CellPlan, cell_history
from stitch.plugins.watch.tracking import (
    MEMBERS,
    STEADY,
    STILL,
    chart_limits,
    empty_bank,
    empty_charts,
    limit_shares,
    odds_limit,
    predicted_bank,
    slope_odds,
    updated_bank,
    updated_charts,
    with_parameters,
)
from stitch.plugins.watch.update import DAY_SECONDS, RUN_LENGTH, regressor_prior_sigmas, regressors

HALLS, CELLS = 100, 50
_PARAMETERS = 12
_CHANNELS = ["air_temperature_c"]


def silence() -> list[str]:
    """False alarms in so many cell-months, by how large the thermal cycle is."""
    lines = ["**Nothing happens**: false alarms in months of 600 sessions; the limits are for one in 200", ""]
    lines += ["| thermal cycle, sigmas | cell-months | false alarms | in 100 cell-months | 95 % interval |"]
    lines += ["|---:|---:|---:|---:|---|"]
    for k, thermal in enumerate((1.0, 4.0)):
        alarms, months = 0, 0
        for hall in range(HALLS // 2):
            alarms += alarms_of_hall(1000 * k + hall, thermal)
            months += CELLS
        low, high = chi2.ppf([0.025, 0.975], [2 * alarms or 1, 2 * alarms + 2]) / 2 / months * 100
        low = 0.0 if alarms == 0 else low
        lines.append(f"| {thermal:g} | {months:,} | {alarms} | {100 * alarms / months:.2f} | {low:.2f} to {high:.2f} |")
    return lines


def alarms_of_hall(hall: int, thermal: float) -> int:
    """Alarms of `CELLS` cells that share hours and air; a parameter that alarmed begins anew with its charts."""
    plan = CellPlan(knock_day=None, growth=0.0, thermal=thermal)
    cells = [cell_history(10_000 * hall + k, plan, hall=hall) for k in range(CELLS)]
    times, air = cells[0].time, cells[0].air_temperature_c
    found, sigma = np.hstack([c.found for c in cells]), np.concatenate([c.sigma for c in cells])
    covariates = regressors(times, (air - air[0])[:, None], _CHANNELS)
    still = (MEMBERS[STILL], MEMBERS[STEADY])
    bank = with_parameters(
        empty_bank(covariates.shape[1], still), found[0], sigma, regressor_prior_sigmas(_CHANNELS), still
    )
    charts, limit, alarms = empty_charts(found.shape[1]), chart_limits(RUN_LENGTH, _PARAMETERS), 0
    sloped = np.zeros(found.shape[1], bool)
    days = np.diff(times, prepend=times[0]) / DAY_SECONDS
    for k in range(len(times)):
        bank, innovations = updated_bank(predicted_bank(bank, days[k]), found[k], sigma, covariates[k])
        charts = updated_charts(charts, innovations)
        odds = slope_odds(bank, 0, 1) / odds_limit(_PARAMETERS)
        new, sloped = (odds >= 1) & ~sloped, sloped | (odds >= 1)
        hit = (limit_shares(charts, limit).max(axis=1) >= 1) | new
        alarms += int(hit.reshape(CELLS, -1).any(axis=1).sum())
        charts = type(charts)(np.where(hit[:, None, None], 0.0, charts.cusums), np.where(hit, 0.0, charts.ewma))
    return alarms

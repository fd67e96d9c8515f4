"""An effect of one's own: diagnosed, added, and a picture of how the error falls."""

from typing import Any

import numpy as np

import stitch
from data_synth.made_session import make
from stitch.effects import effect, number


@effect("sensor", needs=("humidity_percent",), k=number("mm", 0.01, 0.5))
def humidity_bias(points: Any, view: Any, k: float) -> Any:
    """x = x* + u·k·(H−H₀), u along the ray, H in percent"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))


cell, humidity = make("blade-table", {}, seed=3, views=12), np.linspace(40, 60, 12)  # simulated, in place of yours
steps = zip((cloud.points for cloud in cell.clouds), 0.03 * (humidity - 40), strict=True)
clouds = [p * (1 + k / np.linalg.norm(p, axis=1, keepdims=True)) for p, k in steps]
known = {"humidity_percent": humidity}
run = stitch.run(stitch.Session.from_arrays(clouds, cell.T_base_flange, mount="eye_in_hand", covariates=known))
stitch.add(run, *stitch.diagnose(run).effects).plot("error").savefig("error.png")

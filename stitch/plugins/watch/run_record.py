"""What one run says to the history of its cell; plain data, so that a simulator can write it without the models."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stitch.numerics.frames import Array


@dataclass(frozen=True)
class Estimate:
    """A parameter of an effect as one run found it."""

    name: str  # effect.parameter
    unit: str
    value: float
    sigma: float


@dataclass(frozen=True)
class RunRecord:
    """One run; lengths in length_unit, angles in rad."""

    path: Path  # of the run
    session: str  # path of the session
    name: str
    run_hash: str  # SHA-256 of model.toml and result.json
    session_hash: str  # of the session's tables; of the run where these have gone
    time: float  # s since 1970, UTC
    time_from: str  # how that is known
    length_unit: str
    mount: str
    T_mount: Array  # (4, 4)
    covariance: Array  # (6, 6) of T·exp(ξ), scanner frame
    estimates: tuple[Estimate, ...]
    covariates: dict[str, float]
    numbers: dict[str, float]  # residual, held-out error, noise floor, repeatability
    document: dict[str, Any]  # result.json

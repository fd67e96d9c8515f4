"""What a cell has to say, as plain data: where its parameters are, what moves, until when the calibration holds."""

from dataclasses import dataclass

from stitch.watch.changes import Change


@dataclass(frozen=True)
class FollowedChannel:
    """A channel that a parameter follows."""

    channel: str
    per_unit: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class ParameterReport:
    """One parameter, in its unit."""

    name: str
    unit: str
    value: float  # at the conditions of the last session
    sigma: float  # with what all sessions have in common
    common_sigma: float
    scatter: float  # of sessions, as a share of their stated sigmas
    drift_per_day: float
    drift_sigma: float
    process_noise: float  # per √day, of the likeliest member
    follows: tuple[FollowedChannel, ...]
    in_use: float  # in the calibration in use; NaN where that does not have it
    limit: float  # how far from there it may be
    valid_until: float | None  # s since 1970; None beyond the horizon
    changes: tuple[Change, ...]
    alarm: Change | None  # the latest that stands


@dataclass(frozen=True)
class CellReport:
    """A cell after its last session."""

    name: str
    length_unit: str
    sessions: int
    first: float  # s since 1970
    last: float
    in_use: str  # name of the session whose calibration is used
    parameters: tuple[ParameterReport, ...]
    run_names: dict[int, str]  # of the sessions that changes name
    run_times: dict[int, float]
    run_length: float

    @property
    def alarms(self) -> list[tuple[ParameterReport, Change]]:
        """Those that stand, in the order of their onsets."""
        standing = [(p, p.alarm) for p in self.parameters if p.alarm is not None]
        return sorted(standing, key=lambda item: self.run_times[item[1].since])

    @property
    def recalibrate_before(self) -> float | None:
        """The earliest end of validity, s since 1970."""
        return min((p.valid_until for p in self.parameters if p.valid_until is not None), default=None)

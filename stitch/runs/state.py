"""A run as far as the next question needs it: what was measured, the model, and its history."""

from dataclasses import dataclass, field

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.model.model import Model
from stitch.runs.run import ExcludedView, LedgerStep, Run, ViewLinks


@dataclass(frozen=True)
class RunState:
    """What was measured, the model, and its history."""

    session: Session
    measurement: Measurement
    model: Model
    T_mount_coarse: Array  # (4, 4)
    gate: float  # largest distance between partners, length_unit; NaN without clouds
    residual_rms: float
    noise_floor: float
    ledger: tuple[LedgerStep, ...]
    effects_file: str | None
    left_out: tuple[
        ExcludedView, ...
    ] = ()  # views of the session that do not count; session and measurement are without
    links: ViewLinks = field(default_factory=ViewLinks)
    doubts: tuple[str, ...] = ()  # of the session as a whole, as sentences
    register: str = ""  # method of register; empty: the usual one

    @property
    def heldout_rms(self) -> float:
        """On views left out, length_unit; that of the fit where the history does not know it."""
        known = self.ledger[-1].heldout_rms if self.ledger else np.nan
        return known if np.isfinite(known) else self.residual_rms

    def __repr__(self) -> str:
        return f"State({self.session.name!r}, {len(self.session.views)} views, {self.model!r})"


def state_of(run: Run) -> RunState:
    """The state of a run in memory."""
    return RunState(
        session=run.session,
        measurement=run.measurement,
        model=run.model,
        T_mount_coarse=run.T_mount_coarse,
        gate=float("nan") if run.overlaps is None else run.overlaps.gate,
        residual_rms=run.residual_rms,
        noise_floor=run.noise_floor,
        ledger=run.ledger,
        effects_file=run.effects_file,
        left_out=run.left_out,
        links=run.links,
        doubts=run.doubts,
        register=run.register_method,
    )

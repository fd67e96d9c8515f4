"""What became of one session: a row of the table, of the page and of batch.json."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stitch.errors import InputError, StitchError
from stitch.stored.run_documents import read_result
from stitch.units import MICROMETRES


@dataclass(frozen=True)
class SessionRow:
    """Lengths in µm; None where nothing was measured."""

    session: str
    name: str  # of the run's folder
    run: str | None = None  # folder; None without a result
    skipped: bool = False  # its run stood there
    error: str | None = None
    bad_input: bool = False
    verdict: str | None = None
    views: int | None = None  # that are fused
    left_out: int | None = None  # views
    coarse_um: float | None = None  # rms before the hand-eye is corrected
    residual_um: float | None = None  # rms with one hand-eye
    registered_um: float | None = None  # rms after every view has a pose of its own
    noise_floor_um: float | None = None
    worst_view: str | None = None  # of the largest rms after register
    worst_view_um: float | None = None
    seconds: float | None = None  # of its stages

    def urgency(self) -> tuple[bool, float]:
        """Sorts those first that need somebody: without a result, then by what one hand-eye leaves above the noise."""
        if self.residual_um is None or not self.noise_floor_um:
            return self.error is None, 0.0
        return True, -self.residual_um / self.noise_floor_um


def finished_row(session: Path, run: Path, skipped: bool = False) -> SessionRow:
    """The row of a session with a run.

    Raises:
        InputError: no run folder of one session, or a damaged one.
    """
    document = read_result(run)
    to_um = MICROMETRES[document["length_unit"]]
    rms = {stage["name"]: stage["rms"] for stage in document["stages"]}
    views = [view for view in document["views"] if view["rms"] is not None]
    worst = max(views, key=lambda view: float(view["rms"]), default=None)
    left_out = len(document.get("left_out", ()))

    def um(value: Any) -> float | None:
        return None if value is None else float(value) * to_um

    return SessionRow(
        session=str(session),
        name=run.name,
        run=str(run),
        skipped=skipped,
        verdict=document["verdict"],
        views=len(document["views"]) - left_out,
        left_out=left_out,
        coarse_um=um(rms.get("coarse")),
        residual_um=um(document["residual_rms"]),
        registered_um=um(rms.get("register")),
        noise_floor_um=um(document["noise_floor"]),
        worst_view=None if worst is None else worst["view"],
        worst_view_um=None if worst is None else um(worst["rms"]),
        seconds=sum(float(stage["seconds"]) for stage in document["stages"]),
    )


def failed_row(session: Path, run: Path, error: BaseException) -> SessionRow:
    """The row of a session without a result: why, in one line."""
    kind = "" if isinstance(error, StitchError) else f"{type(error).__name__}: "
    told = f"{kind}{' '.join(str(error).split())}"
    return SessionRow(str(session), run.name, error=told, bad_input=isinstance(error, InputError))

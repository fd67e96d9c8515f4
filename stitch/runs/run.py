"""What a run computed, as plain frozen data; `writing` puts it on disk."""

import re
from dataclasses import dataclass, field

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.model.model import Model, Term
from stitch.observations.surfaces.hand_eye_fit import Repeatability
from stitch.observations.surfaces.normal_equations import Overlaps
from stitch.observations.targets.outliers import Outlier
from stitch.observations.targets.target_model import TargetModelFit

# A doubt of a session as a whole in one clause: what it means and what to do stands elsewhere.

_CLAUSE_END = re.compile(r"[:.] ")


def doubt_headline(doubt: str) -> str:
    """A doubt up to its first colon or full stop outside brackets."""
    ends = (found.start() for found in _CLAUSE_END.finditer(doubt) if _brackets_closed(doubt[: found.start()]))
    return f"{doubt[: next(ends, len(doubt.rstrip('.')))]}."


def _brackets_closed(text: str) -> bool:
    return text.count("(") == text.count(")")


# By which methods register moves single views, for people.
METHOD_TITLES = {"dpwvm": "DPWVM-style weighted fit", "gicp": "plane to plane (GICP) inside Tukey's biweight"}


@dataclass(frozen=True)
class StageResult:
    """One row of the stage table."""

    name: str  # coarse | correct | register | fuse
    rms: float  # length_unit
    correspondences: int
    iterations: int
    seconds: float
    note: str = ""  # one plain sentence for people
    method: str = ""  # of register, between surfaces: dpwvm | gicp

    @property
    def remark(self) -> str:
        """The method in words, and the note."""
        return "; ".join(text for text in (METHOD_TITLES.get(self.method, self.method), self.note) if text)


@dataclass(frozen=True)
class FusedCloud:
    """The stitched cloud in the reference frame."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    residual: Array  # (N,) rms distance of the views' surfaces from this one, NaN if one view only
    count: Array  # (N,) number of views that see the place


@dataclass(frozen=True)
class ExcludedView:
    """A view that is not fused, and why."""

    view: str
    why: str
    pose: Array  # (4, 4) T_reference_scanner of the model, where the robot says it stood
    points: int = 0  # of its scan


@dataclass(frozen=True)
class ViewLinks:
    """How the views hold each other, by their names."""

    components: tuple[tuple[str, ...], ...] = ()  # largest first
    weak: tuple[tuple[str, str], ...] = ()  # (view, its only partner)


@dataclass(frozen=True)
class Note:
    """What a reviewer remarked on a step."""

    at: str  # ISO 8601
    by: str  # empty where nobody signed
    text: str


@dataclass(frozen=True)
class LedgerStep:
    """One change of the model: a line of ledger.json."""

    effects: tuple[str, ...]
    residual_rms: float
    heldout_rms: float
    noise_floor: float
    T_mount: Array  # (4, 4)
    values: dict[str, dict[str, float]] = field(default_factory=dict)  # effect -> parameter -> value
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True)
class Run:
    """Result of one session, as `result.json` and the report show it; lengths in length_unit, angles in rad."""

    session: Session
    measurement: Measurement  # as it counts: without outliers
    model: Model
    T_mount_coarse: Array  # (4, 4)
    unobservable: tuple[str, ...]  # plain words, one per unobservable direction
    stages: tuple[StageResult, ...]
    poses_model: Array  # (V, 4, 4) T_reference_scanner of the model (robot, hand-eye, effects)
    poses: Array  # (V, 4, 4) T_reference_scanner after register
    corrections: Array  # (V, 6) twists: poses = exp(corrections) @ poses_model, reference frame
    view_rms: Array  # (V,)
    residual_rms: float
    heldout_rms: float
    noise_floor: float
    fused: FusedCloud
    repeatability: Repeatability  # of the flange poses, as the overlaps show it
    overlaps: Overlaps | None  # correspondences of the model, before register moves single views; None without clouds
    verdict: str  # one plain sentence
    registered: Overlaps | None = None  # correspondences found anew after register: what scatters there is noise
    ledger: tuple[LedgerStep, ...] = ()
    effects_file: str | None = None
    convergence: dict[str, list[float]] = field(default_factory=dict)  # stage -> rms per iteration
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()  # of the session as a whole, as sentences: they stand before the verdict
    targets: TargetModelFit | None = None  # what the labelled points say, where there are any
    outliers: tuple[Outlier, ...] = ()  # labelled points that do not count
    left_out: tuple[
        ExcludedView, ...
    ] = ()  # views of the session that are not fused; all other fields are without them
    links: ViewLinks = field(default_factory=ViewLinks)

    @property
    def T_mount(self) -> Array:
        """(4, 4) corrected hand-eye."""
        return self.model.T_mount

    @property
    def mount_covariance(self) -> Array:
        """(6, 6) of the right perturbation T·exp(ξ), scanner frame, rotation first."""
        return self.model.covariance

    @property
    def terms(self) -> tuple[Term, ...]:
        """Effects in use."""
        return self.model.terms

    @property
    def effects(self) -> list[str]:
        """Names of the effects in use."""
        return self.model.effects

    @property
    def register_method(self) -> str:
        """By which method single views were registered; empty without clouds."""
        return next((stage.method for stage in self.stages if stage.method), "")

    def __repr__(self) -> str:
        unit = self.session.length_unit
        return (
            f"Run({self.session.name!r}, {len(self.session.views)} views, residual {self.residual_rms:.4g} {unit}, "
            f"held-out {self.heldout_rms:.4g} {unit}, {self.model!r})"
        )


# A run as far as the next question needs it: what was measured, the model, and its history.


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

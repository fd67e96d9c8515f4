"""What a run computed, as plain frozen data; `writing` puts it on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from stitch.measurement.measurement import Measurement, Term
from stitch.frames import Array
from stitch.observations.surfaces.overlaps import Overlaps
from stitch.observations.surfaces.pose_channel import Repeatability
from stitch.measurement.session import Session

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis
    from stitch.stages.target_fit import LabelledFit
    from stitch.observations.targets.outliers import Outlier


@dataclass(frozen=True)
class StageResult:
    """One row of the stage table."""

    name: str  # coarse | correct | register | fuse
    rms: float  # length_unit
    correspondences: int
    iterations: int
    seconds: float
    note: str = ""  # one plain sentence for people


@dataclass(frozen=True)
class FusedCloud:
    """The stitched cloud in the reference frame."""

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    residual: Array  # (N,) rms distance of the views' surfaces from this one, NaN if one view only
    count: Array  # (N,) number of views that see the place


@dataclass(frozen=True)
class Step:
    """One change of the model: a line of ledger.json."""

    effects: tuple[str, ...]
    residual_rms: float
    heldout_rms: float
    noise_floor: float
    T_mount: Array  # (4, 4)


@dataclass(frozen=True)
class Run:
    """Everything `result.json` and the report show."""

    session: Session
    measurement: Measurement  # what was measured
    T_mount: Array  # (4, 4) corrected hand-eye
    T_mount_coarse: Array  # (4, 4)
    mount_covariance: Array  # (6, 6) of the right perturbation T·exp(ξ), rotation first
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
    terms: tuple[Term, ...] = ()  # effects in use
    sigmas: tuple[Array, ...] = ()  # per term (P,); NaN where the views cannot see a parameter
    ledger: tuple[Step, ...] = ()
    effects_file: str | None = None
    poses_before: Array | None = None  # (V, 4, 4) poses_model before the last change of the model
    convergence: dict[str, list[float]] = field(default_factory=dict)  # stage -> rms per iteration
    notes: tuple[str, ...] = ()
    labelled: LabelledFit | None = None  # what the labelled points say, where there are any
    outliers: tuple[Outlier, ...] = ()  # labelled points that do not count

    def diagnose(self) -> Diagnosis:
        """Which effect is missing."""
        from stitch.diagnosis.diagnose import diagnose
        from stitch.stored.load_state import state_of

        return diagnose(state_of(self))

    def add(self, *effects: str) -> Run:
        """The run with further effects in its model, fitted anew."""
        from stitch.pipeline import change
        from stitch.stored.load_state import state_of

        return change(state_of(self), [*self.effects, *(e for e in effects if e not in self.effects)])

    def drop(self, *effects: str) -> Run:
        """The run without some effects, fitted anew."""
        from stitch.pipeline import change
        from stitch.stored.load_state import state_of

        return change(state_of(self), [e for e in self.effects if e not in effects])

    @property
    def effects(self) -> Sequence[str]:
        """Names of the effects in use."""
        return [term.effect.name for term in self.terms]

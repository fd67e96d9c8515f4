"""What a run computed, as plain frozen data; `run_folder.py` writes it to disk."""

from dataclasses import dataclass, field

from stitch.frames import Array
from stitch.overlaps import Overlaps
from stitch.repeatability import Repeatability
from stitch.session import Session


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
class Run:
    """Everything `result.json` and the report show."""

    session: Session
    T_mount: Array  # (4, 4) corrected hand-eye
    T_mount_coarse: Array  # (4, 4)
    mount_covariance: Array  # (6, 6) of the right perturbation T·exp(ξ), rotation first
    unobservable: tuple[str, ...]  # plain words, one per unobservable direction
    stages: tuple[StageResult, ...]
    poses_model: Array  # (V, 4, 4) T_reference_scanner of the model (robot + hand-eye)
    poses: Array  # (V, 4, 4) T_reference_scanner after register
    corrections: Array  # (V, 6) twists: poses = exp(corrections) @ poses_model, reference frame
    view_rms: Array  # (V,)
    residual_rms: float
    heldout_rms: float
    noise_floor: float
    fused: FusedCloud
    repeatability: Repeatability  # of the flange poses, as the overlaps show it
    overlaps: Overlaps  # correspondences of the model, before register moves single views
    verdict: str  # one plain sentence
    convergence: dict[str, list[float]] = field(default_factory=dict)  # stage -> rms per iteration
    notes: tuple[str, ...] = ()

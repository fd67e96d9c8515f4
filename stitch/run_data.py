"""What a run computed, as plain frozen data; `output` puts it on disk."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, Self, TypeVar

import numpy as np

from stitch.model.axis_places import AxisPlace, axis_places
from stitch.model.forward import corrected_capture
from stitch.model.model import Model, Term
from stitch.numerics.frames import Array
from stitch.numerics.units import length_text
from stitch.observations.scanner_places import ScannerAlone, ScannerPlace, scanner_places
from stitch.observations.surfaces.hand_eye_fit import Repeatability
from stitch.observations.surfaces.normal_equations import Overlaps, collect_overlaps
from stitch.observations.targets.outliers import Outlier
from stitch.observations.targets.target_model import TargetModelFit
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData
from stitch.system.threads import library_threads_off
from stitch.system.values import Table, Value

Passed = TypeVar("Passed")
# By which methods register moves single views, for people.
METHOD_TITLES = {
    "dpwvm": "DPWVM-style weighted fit",
    "gicp": "plane to plane (GICP) inside Tukey's biweight",
    "vmm": "variance minimisation in two classes (VMM)",
}
# Chance that a given hand-eye which is right is doubted.
_DOUBTED = 0.01
# A hand-eye that is off by so many of its U would be found: else these views do not say whether it is right.
FOUND_FROM = 5.0
# Where the first clause of a doubt ends: what it means and what to do comes after.
_CLAUSE_END = re.compile(r"[:.] |; to fix: ")


@dataclass(frozen=True, eq=False)
class StageResult(Value):
    """One row of the stage table.

    Example:
        >>> [stage.name for stage in run.stages]
        ['coarse', 'correct', 'register', 'fuse']
    """

    name: str  # coarse | correct | register | fuse
    rms: float  # length_unit
    correspondences: int
    iterations: int
    seconds: float = field(compare=False)
    note: str = ""  # one plain sentence for people
    method: str = ""  # of register, between surfaces: dpwvm | gicp | vmm

    @property
    def remark(self) -> str:
        """The method in words and the note, with a semicolon between them; either may be empty."""
        return "; ".join(text for text in (METHOD_TITLES.get(self.method, self.method), self.note) if text)


@dataclass(frozen=True, eq=False)
class FusedCloud(Value):
    """The stitched cloud in the reference frame; lengths in length_unit.

    Example:
        >>> run.fused.points.shape == run.fused.normals.shape, int(run.fused.count.max())
        (True, 5)
    """

    points: Array  # (N, 3)
    normals: Array  # (N, 3)
    residual: Array  # (N,) rms distance of the views' surfaces from this one, NaN if one view only
    count: Array  # (N,) number of views that see the place


@dataclass(frozen=True, eq=False)
class Unsupported(Value):
    """Numbers of scanned points, and of those that are not in the stitched cloud.

    Example:
        >>> 0 <= run.fit.unsupported.share < 1
        True
    """

    points: int = 0  # scanned points, in the cloud or not
    alone: int = 0  # on no surface of their own view or of others
    looked_through: int = 0  # other views look past them

    def __add__(self, other: "Unsupported") -> "Unsupported":
        """Return the numbers of two sets of points together."""
        alone, through = self.alone + other.alone, self.looked_through + other.looked_through
        return Unsupported(self.points + other.points, alone, through)

    @property
    def share(self) -> float:
        """The share of all scanned points that are not in the stitched cloud, 0 to 1."""
        return (self.alone + self.looked_through) / max(self.points, 1)


@dataclass(frozen=True, eq=False)
class Fusion(Value):
    """What the stage fuse makes of registered views; lengths in length_unit.

    Example:
        >>> run.fit.fusion.stage.name, run.fit.fusion.cloud.points.shape[1]
        ('fuse', 3)
    """

    cloud: FusedCloud
    unsupported: Unsupported = field(default_factory=Unsupported)
    stage: StageResult | None = None  # None: targets stand in for a cloud


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
    predicted: float = float("nan")  # heldout_rms, by the diagnosis that named what was added


@dataclass(frozen=True, eq=False)
class Fit(Value):
    """What the stages found of one session under its model; lengths in length_unit, angles in rad.

    `fusion_source` is what fuse made of it; while a thread still fuses, it is a function that waits for that.

    Example:
        >>> run.fit.poses.shape, run.fit.corrections.shape
        ((5, 4, 4), (5, 6))
    """

    stages_before: tuple[StageResult, ...]  # coarse, correct, register
    poses_model: Array  # (V, 4, 4) T_reference_scanner of the model (robot, hand-eye, effects)
    poses: Array  # (V, 4, 4) T_reference_scanner after register
    view_rms: Array  # (V,) NaN for a view without partners, or without a target that counts
    fusion_source: Fusion | Callable[[], Fusion] = field(compare=False)
    repeatability: Repeatability  # of the flange poses, as the overlaps show it
    verdict: str  # one plain sentence
    convergence: dict[str, list[float]]  # stage -> rms per iteration
    corrections: Array  # (V, 6) twists: poses = exp(corrections) @ poses_model, reference frame
    # Correspondences of the model, before register moves single views; and found anew after it: what scatters is noise.
    overlaps: Overlaps | None = field(default=None, compare=False)
    registered: Overlaps | None = field(default=None, compare=False)
    targets: TargetModelFit | None = None  # what the labelled points say, where there are any
    outliers: tuple[Outlier, ...] = ()  # labelled points that do not count
    unobservable: tuple[str, ...] = ()  # plain words, one per unobservable direction
    unknown: tuple[str, ...] = ()  # of x, y, z, rx, ry, rz of the hand-eye: what those directions leave open
    notes: tuple[str, ...] = ()
    # (6,) sigma of the hand-eye with usual sizes of what these views cannot show, as `hand_eye_sigma` counts
    sigma_anywhere: Array | None = None

    @property
    def fusion(self) -> Fusion:
        """What fuse made of the views; waits where they are still being fused.

        Raises:
            InputError: a scan changed on disk since it was read.
        """
        if not isinstance(self.fusion_source, Fusion):
            # Of a function only the result is kept: a copy has no thread to wait for.
            vars(self)["fusion_source"] = self.fusion_source()
        assert isinstance(self.fusion_source, Fusion)
        return self.fusion_source

    @property
    def fused(self) -> FusedCloud:
        """The stitched cloud."""
        return self.fusion.cloud

    @property
    def unsupported(self) -> Unsupported:
        """Points that are not in the stitched cloud."""
        return self.fusion.unsupported

    @property
    def stages(self) -> tuple[StageResult, ...]:
        """Rows of the stage table: coarse, correct, register, fuse."""
        return self.stages_before if self.fusion.stage is None else (*self.stages_before, self.fusion.stage)

    def __getstate__(self) -> dict[str, Any]:
        """Wait for fuse, since a thread cannot be copied."""
        return vars(self) | {"fusion_source": self.fusion}

    def _stored(self) -> dict[str, Any]:
        after = {"stages": self.stages, "fused": self.fused, "unsupported": self.unsupported}
        return {name: value for name, value in super()._stored().items() if name != "stages_before"} | after


@dataclass(frozen=True)
class HandEyeTransfer:
    """How a given hand-eye compares with the one fitted to these views, at the middle of the part.

    Its expanded uncertainties U cover 95 %.
    """

    turn: float  # rad, between the two
    distance: float  # length_unit
    ratio: float  # of the difference to the largest that 95 % of pairs which are the same show, all six numbers
    U: float  # expanded uncertainty of the distance, both hand-eyes together
    U_given: float  # of the given one alone
    p_value: float  # that two hand-eyes which are the same differ by as much

    @property
    def holds(self) -> bool:
        """True unless the views contradict the given hand-eye beyond chance."""
        return self.p_value >= _DOUBTED

    @property
    def decides(self) -> bool:
        """True if these views would show a given hand-eye that is off by `FOUND_FROM` times its own U."""
        return FOUND_FROM * self.U_given >= self.U

    def sentence(self, unit: str) -> str:
        """Return a sentence for people on how the two hand-eyes compare, lengths from length_unit `unit`."""
        away = f"{length_text(self.distance, unit)} and {1e3 * self.turn:.2g} mrad away at the part"
        if self.holds:
            return f"The given hand-eye agrees with these views: the one that they show lies {away}, within U of both."
        return (
            f"The given hand-eye does not fit these views: the one that they show lies {away}, "
            f"{self.ratio:.1f} times what U of both allows; to fix: find it anew, by a run without --hand-eye."
        )


def passed_on(place: str, kind: type[Passed], doc: str) -> Passed:
    """Return a read-only property for an attribute of an attribute, as `fit.poses`.

    Args:
        place: dotted path from the object that has the property.
        kind: type of the value, for annotations.
        doc: docstring of the property.
    """

    def value(owner: Any) -> Any:
        """Return the value at `place`."""
        return attrgetter(place)(owner)

    value.__annotations__["return"] = kind
    return property(value, doc=doc)  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class RunData(Table, document="stitch.output.result_document:result_document", table="views"):
    """One session, its model and its results, as `result.json` and the report show them.

    `source` is the fit itself; of a run read from a folder it is a function that reads it when `fit` is first used.
    """

    session: SessionData  # without the views that were left out
    measurement: Measurement  # as it counts: without outliers
    model: Model
    T_mount_coarse: Array  # (4, 4)
    gate: float  # largest distance between partners, length_unit; NaN without clouds
    residual_rms: float
    heldout_rms: float
    noise_floor: float
    source: Fit | Callable[[Any], Fit]  # what the stages found, or what reads it for this run
    register_method: str = ""  # by which single views were registered; empty without clouds
    ledger: tuple[LedgerStep, ...] = ()
    effects_file: str | None = None
    doubts: tuple[str, ...] = ()  # of the session as a whole, as sentences: they stand before the verdict
    left_out: tuple[ExcludedView, ...] = ()  # views of the session that are not fused
    links: ViewLinks = field(default_factory=ViewLinks)
    alone: tuple[ScannerAlone, ...] = ()  # of several scanners, each by its own views
    tried: dict[str, str] = field(default_factory=dict)  # effects that were fitted and dropped again, and why
    hand_eye_transfer: HandEyeTransfer | None = field(default=None, compare=False)  # of a given one; not stored

    @cached_property
    def fit(self) -> Fit:
        """The fit of the run: stages, poses, fused cloud; read from the run's folder where it is not in memory.

        Raises:
            InputError: a file of the run's folder is damaged, or belongs to another model or session.
        """
        return self.source if isinstance(self.source, Fit) else self.source(self)

    def _stored(self) -> dict[str, Any]:
        return super()._stored() | {"source": self.fit}

    def with_fit(self, **changes: Any) -> Self:
        """Return the run with other values of some fields of `fit`.

        Example:
            >>> run.with_fit(notes=("Scanned twice.",)).notes
            ('Scanned twice.',)
        """
        return replace(self, source=replace(self.fit, **changes))

    @property
    def heldout_or_fit_rms(self) -> float:
        """The rms on held-out views by the last step of the ledger, length_unit; `residual_rms` if that is unknown."""
        known = self.ledger[-1].heldout_rms if self.ledger else np.nan
        return known if np.isfinite(known) else self.residual_rms

    T_mount = passed_on("model.T_mount", Array, "(4, 4) corrected hand-eye.")
    mount_covariance = passed_on(
        "model.covariance", Array, "(6, 6) of the right perturbation T·exp(ξ), scanner frame, rotation first."
    )
    terms = passed_on("model.terms", tuple[Term, ...], "Effects in use.")
    effects = passed_on("model.effects", list[str], "Names of the effects in use.")
    stages = passed_on(
        "fit.stages", tuple[StageResult, ...], "Rows of the stage table: coarse, correct, register, fuse."
    )
    poses_model = passed_on(
        "fit.poses_model", Array, "(V, 4, 4) T_reference_scanner of robot, hand-eye and effects alone, length_unit."
    )
    poses = passed_on("fit.poses", Array, "(V, 4, 4) T_reference_scanner after register, length_unit.")
    corrections = passed_on(
        "fit.corrections", Array, "(V, 6) twists, reference frame: poses = exp(corrections)·poses_model; length_unit."
    )
    view_rms = passed_on(
        "fit.view_rms", Array, "(V,) rms of each view's distances from the others, length_unit; NaN without partners."
    )
    fused = passed_on("fit.fused", FusedCloud, "The stitched cloud as arrays, reference frame, length_unit.")
    repeatability = passed_on(
        "fit.repeatability", Repeatability, "Of the flange's poses, as the overlaps show it; rad and length_unit."
    )
    outliers = passed_on("fit.outliers", tuple[Outlier, ...], "Labelled points that do not count.")
    unobservable = passed_on(
        "fit.unobservable", tuple[str, ...], "Directions of the hand-eye that the views do not show, in plain words."
    )
    unknown = passed_on(
        "fit.unknown", tuple[str, ...], "Of x, y, z, rx, ry, rz of the hand-eye, what those directions leave open."
    )
    verdict = passed_on("fit.verdict", str, "One plain sentence.")
    convergence = passed_on(
        "fit.convergence", dict[str, list[float]], "Stage to rms of each of its iterations, length_unit."
    )
    notes = passed_on("fit.notes", tuple[str, ...], "Sentences for people.")

    @cached_property
    def axes(self) -> tuple[AxisPlace, ...]:
        """Where the external axes stand, with sigma."""
        return axis_places(self.measurement, self.model)

    @cached_property
    def scanners(self) -> tuple[ScannerPlace, ...]:
        """Where several scanners stand, with U; none of one."""
        return scanner_places(self.measurement, self.model, self.alone)

    @cached_property
    def overlaps(self) -> Overlaps | None:
        """Correspondences under the model, before register moves single views; None of labelled points alone.

        Those of a run that was read from its folder are searched when they are asked for.
        """
        if self.fit.overlaps is not None or not self.session.has_clouds:
            return self.fit.overlaps
        with library_threads_off():
            return collect_overlaps(corrected_capture(self.measurement, self.model), self.poses_model, self.gate)

    @property
    def registered(self) -> Overlaps | None:
        """Correspondences found anew after register; None of labelled points alone."""
        return self.fit.registered

    @property
    def targets(self) -> TargetModelFit | None:
        """What the labelled points say; None where there are none."""
        return self.fit.targets

    def __repr__(self) -> str:
        unit = self.session.length_unit
        return (
            f"Run({self.session.name!r}, {len(self.session.views)} views, residual {self.residual_rms:.4g} {unit}, "
            f"held-out {self.heldout_rms:.4g} {unit}, {self.model!r})"
        )


def doubt_headline(doubt: str) -> str:
    """Return the first clause of a doubt, a sentence on the session, with a full stop.

    It ends at the first colon, full stop or "; to fix: " outside brackets, else with the text.
    """
    ends = (end.start() for end in _CLAUSE_END.finditer(doubt))
    outside = (i for i in ends if doubt[:i].count("(") == doubt[:i].count(")"))
    return f"{doubt[: next(outside, len(doubt.rstrip('.')))]}."


def effect_cure(effect: str) -> str:
    """Return the words by which a doubt recommends an effect of the model: "add the effect gear_harmonic"."""
    return f"add the effect {effect}"


def doubt_remedy(doubt: str) -> str:
    """Return the text of a doubt after its first clause (`doubt_headline`), capitalised; empty if there is none."""
    more = doubt[len(doubt_headline(doubt)) - 1 :].lstrip(";:. ")
    return more[:1].upper() + more[1:]

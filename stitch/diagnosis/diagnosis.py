"""What a diagnosis says: verdict, candidate effects, what depends on what, what to measure next."""

from dataclasses import dataclass, field

import numpy as np

from stitch.diagnosis.dependence import Dependence
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.residual_structure import BudgetLine
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unmodelled_joint_effects import JointCurve
from stitch.diagnosis.unmodelled_time_effects import RepeatingError, TimeCurve, reportable
from stitch.diagnosis.validation import CrossValidation
from stitch.diagnosis.verdict import Answer
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError
from stitch.run_data import RunData
from stitch.system.values import Table, Value


@dataclass(frozen=True, eq=False)
class Proposal(Value):
    """One measurement.

    Example:
        >>> [proposal.separates for proposal in stitch.next_view(run)]
        [...]
    """

    do: str  # plain words
    separates: tuple[str, ...]
    joints_deg: list[float] | None = None
    views: int | None = None  # how many such views are needed
    T_base_flange: list[list[float]] | None = None  # (4, 4) length_unit, at those joints
    wait_s: float = 0.0  # after the last view, beside the usual pause
    probability: float | None = None  # that the right one of the rivals is named after it and the poses before it


@dataclass(frozen=True)
class CandidateEffect:
    """One candidate as diagnosis.json shows it."""

    ranked: Ranked
    aliases: dict[str, float]  # effects that could do what this one does, and their correlation, largest first
    cross_validation: CrossValidation | None
    detectable: dict[str, float]  # smallest detectable size per parameter, alone
    hand_eye: float | None  # how far it would push the hand-eye unseen, length_unit (`omitted_effect_bias`)
    shape: float | None  # by how much it would bend the scans unseen, rms, length_unit (`unseen_shape_error`)

    @property
    def name(self) -> str:
        """The name of the effect."""
        return self.ranked.name


@dataclass(frozen=True)
class Finding:
    """What a diagnosis names, as far as adding it needs that: of one made now, or of one that lies on disk."""

    lines: tuple[str, ...]  # finding, evidence and notes, in words
    names: tuple[str, ...]  # effects that are missing beside each other, the one that is named first
    validations: dict[str, CrossValidation]  # of candidates, by name


@dataclass(frozen=True, eq=False)
class Diagnosis(Table, document="stitch.output.diagnosis_document:diagnosis_document", table="candidates"):
    """Verdict, candidate effects, what the rest depends on, what to measure next.

    Example:
        >>> found = stitch.diagnose(run)
        >>> print(found.sentence)
        The model is adequate. The residual is ...
        >>> found.candidates[0].name in found.missing
        False
    """

    verdict: str
    named: tuple[Ranked, ...]  # the effect that is missing, or the group that these views cannot tell apart
    sentence: str
    residual_rms: float  # length_unit
    heldout_rms: float  # the same on views left out
    noise_floor: float
    rotation: float  # repeatability under the present model, rad
    translation: float  # length_unit
    candidates: tuple[CandidateEffect, ...]
    matrix: Array  # (S, S) alias matrix of the candidates
    depends_on: tuple[Dependence, ...]
    missing: dict[str, tuple[str, ...]]  # effects that cannot be tested, and what they lack
    linear: LinearModel
    run: RunData = field(repr=False)  # that was diagnosed
    scatter_limit: ScatterLimit  # that no sound arm exceeds, or that is stated
    implausible: bool  # the poses scatter by more than that
    expected_scatter: ScatterLimit  # that is stated, or of an ordinary arm
    beyond_expected: bool  # the views show more than that leaves
    next: tuple[Proposal, ...] = ()  # what to measure next, once `stitch.diagnose` has planned it
    notes: tuple[str, ...] = ()
    repeating_errors: tuple[RepeatingError, ...] = ()  # kinds of errors that repeat, where nothing is named
    budget: tuple[BudgetLine, ...] = ()  # of what the poses leave
    curves: tuple[JointCurve, ...] = ()  # where single joints err without a name, along angles and moves
    log_odds_over_nothing: float = np.inf  # log odds of what is named over nothing being missing
    # rms that remains beside the noise however the views are moved, where it is more; length_unit
    overlap_misfit: float = 0.0
    follows_field: bool = False  # nothing is named, and what is left follows the place in the scanner's field
    scanner_error: FieldError | None = None  # errors that are smooth over that field, where they are part of the answer
    # Of the session as a whole, as sentences: what is found may be no more than their mark.
    doubts: tuple[str, ...] = ()
    coincidence: str = ""  # of `Evidence`
    laws: tuple[Ranked, ...] = ()  # of the dictionary: rivals of what is named, or what is found where nothing is
    rival_trend: str = ""  # of `Evidence`
    places: tuple[str, ...] = ()  # where something acts that follows too many laws alike to tell any
    beyond_belief: tuple[str, ...] = ()  # parameters of what is named that are larger than is believed of them
    together: tuple[str, ...] = ()  # effects that are missing beside each other, the one that is named first
    tried: dict[str, str] = field(default_factory=dict)  # effects that were fitted in this run and dropped, and why
    answers: tuple[Answer, ...] = ()  # of the questions that led to the verdict; the last that changed it decided

    @property
    def effects(self) -> tuple[str, ...]:
        """The names of what is missing."""
        return tuple(r.name for r in self.named)

    @property
    def certain(self) -> bool:
        """False where a name, or a group, is less than 20 to 1 likelier than nothing, or larger than believable."""
        return self.log_odds_over_nothing > ODDS and not self.beyond_belief

    @property
    def dropped_before(self) -> str | None:
        """Why the one effect that is named was dropped in this run before; None where it was not tried."""
        return self.tried.get(self.effects[0]) if self.verdict == "missing_effect" else None

    def rms_if_added(self, validation: CrossValidation) -> tuple[float, float]:
        """Return the rms with an effect, in the fit and on views left out (length_unit).

        Example:
            >>> found = stitch.diagnose(run)
            >>> fit, heldout = found.rms_if_added(found.candidates[0].cross_validation)
            >>> fit > 0 and heldout > 0
            True
        """
        return self.residual_rms * validation.inside**0.5, self.heldout_rms * validation.heldout**0.5

    @property
    def likelier_than_not(self) -> bool:
        """False where a name, or a group, is less likely than nothing being missing."""
        return self.log_odds_over_nothing > 0

    @property
    def time_curve(self) -> TimeCurve | None:
        """The motion of the flange in time, where it is reported."""
        reported = reportable(self.repeating_errors, self.implausible)
        return next((error.curve for error in reported if error.curve is not None), None)

    def __repr__(self) -> str:
        return f"Diagnosis({self.verdict}: {self.sentence})"

"""The verdict of a diagnosis, decided in one place from evidence that was gathered before."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.unnamed_time_laws import RepeatingError
from stitch.diagnosis.validation import CrossValidation
from stitch.observations.surfaces.scanner_errors import FieldError

Verdict = Literal["adequate", "missing_effect", "cannot_tell", "unknown_effect"]


@dataclass(frozen=True)
class Evidence:
    """Everything that a verdict rests on (`gather_evidence`), and the names that follow from it."""

    ranked: tuple[Ranked, ...]  # physical effects, best first, unobservable last
    empirical: tuple[Ranked, ...]  # shapes without a cause, best first
    # An effect or a shape is 12 to 1 over nothing at a family-wise p < 0.04, and views left out do not refute it.
    alarm: bool = False
    # Effects of which each would explain the alarm, likeliest first; alone where none comes within 20 to 1.
    explanation: tuple[Ranked, ...] = ()
    together: tuple[Ranked, ...] = ()  # effects that were selected beside each other, the first to be named first
    further: Ranked | None = None  # an effect that is missing too, beside the first of `explanation`
    unnamed_explains_it: bool = False  # an error without a name explains these views as well as `explanation`
    refuted: bool = False  # `explanation` fails on views left out, in halves of the views, or rests on one view
    # smooth errors of the scans, beside `explanation`; None: usual or not asked
    scanner_error: FieldError | None = None
    repeating_errors: tuple[RepeatingError, ...] | None = None  # pose errors without a name; None: not asked
    implausible_scatter: bool = False  # the poses scatter by more than is stated, or than any sound arm does
    # of effects that may be named, beside all that each was named beside
    left_out: Mapping[str, CrossValidation] = field(default_factory=dict)
    overlap_misfit: float = 0.0  # rms that no motion of the views removes, where it exceeds the noise; length_unit
    notes: tuple[str, ...] = ()  # effects that explain much and are not named, and why
    coincidence: str = ""  # why a jump in time cannot be told from an error of a joint that turns back

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict that this evidence gives."""
        return decide(self)

    @property
    def named(self) -> tuple[Ranked, ...]:
        """The effect that is missing, or the group that these views cannot tell apart; () where nothing is named."""
        return self.explanation if self.verdict in ("missing_effect", "cannot_tell") else ()

    @property
    def second(self) -> Ranked | None:
        """The effect that is missing beside the first; None where nothing is named."""
        return self.further if self.named else None

    @property
    def log_odds_over_nothing(self) -> float:
        """Log odds of the name, or of one of the group, over nothing being missing; infinite where none is given."""
        odds = [r.log_odds_over_nothing for r in self.named]
        return float(logsumexp(odds)) if odds else np.inf


def decide(e: Evidence) -> Verdict:
    """Return the verdict: the first row of the table in docs/diagnosis.md ("The verdict") whose condition holds."""
    explained = bool(e.explanation) and not (e.unnamed_explains_it or e.refuted or scanner_explains_it(e))
    scanner_errs = e.scanner_error is not None and e.scanner_error.over_noise
    if explained and len(e.explanation) == 1:
        return "missing_effect"
    if explained:
        return "cannot_tell"
    if e.alarm or e.repeating_errors or e.implausible_scatter or scanner_errs or e.overlap_misfit > 0:
        return "unknown_effect"
    return "adequate"


def scanner_explains_it(e: Evidence) -> bool:
    """True where smooth errors of the scans gain at least as many nats as the effect that would be named.

    Poses found from scans that err are off too, and an effect that explains some of that is not thereby there.
    """
    return (
        e.scanner_error is not None
        and len(e.explanation) == 1
        and e.scanner_error.gain >= e.explanation[0].score.log_bayes_factor
    )

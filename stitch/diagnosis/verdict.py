"""The verdict of a diagnosis, decided in one place from evidence that was gathered before."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.ranking import Ranked, stands_out
from stitch.diagnosis.systematic_laws import Dictionary, law_of
from stitch.diagnosis.unmodelled_time_effects import RepeatingError
from stitch.diagnosis.validation import CrossValidation
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError

Verdict = Literal["adequate", "missing_effect", "cannot_tell", "unknown_effect"]


@dataclass(frozen=True)
class Answer:
    """What one question of a diagnosis was answered."""

    name: str  # of the question: `which_explains_most`
    question: str  # as a sentence
    text: str  # of the answer
    changed: bool  # the verdict, or what is named: the last answer that did decided


@dataclass(frozen=True)
class Evidence:
    """Everything that a verdict rests on (`gather_evidence`), and the names that follow from it."""

    ranked: tuple[Ranked, ...]  # physical effects, best first, unobservable last
    empirical: tuple[Ranked, ...]  # shapes without a cause, best first
    laws: tuple[Ranked, ...] = ()  # of the dictionary that no effect says, likeliest first
    rival_laws: tuple[Ranked, ...] = ()  # those of them that explain the views as well as what is named
    rival_trend: str = ""  # the smooth error without a name that explains them as well, in words
    # An effect or a shape is 12 to 1 over nothing at a family-wise p < 0.04, and views left out do not refute it.
    alarm: bool = False
    # Effects of which each would explain the alarm, likeliest first; alone where none comes within 20 to 1.
    explanation: tuple[Ranked, ...] = ()
    together: tuple[Ranked, ...] = ()  # effects that were selected beside each other, the first to be named first
    further: Ranked | None = None  # an effect that is missing too, beside the first of `explanation`
    unmodelled_explains_it: bool = False  # an error without a name explains these views as well as `explanation`
    refuted: bool = False  # `explanation` fails on views left out, in halves of the views, or rests on one view
    # smooth errors of the scans, beside `explanation`; None: usual or not asked
    scanner_error: FieldError | None = None
    repeating_errors: tuple[RepeatingError, ...] | None = None  # pose errors without a name; None: not asked
    implausible_scatter: bool = False  # the poses scatter by more than is stated, or than any sound arm does
    beyond_expected: bool = False  # the views show more than the scatter that is stated, or of an ordinary arm, leaves
    # of effects that may be named, beside all that each was named beside
    left_out: Mapping[str, CrossValidation] = field(default_factory=dict)
    overlap_misfit: float = 0.0  # rms that no motion of the views removes, where it exceeds the noise; length_unit
    notes: tuple[str, ...] = ()  # effects that explain much and are not named, and why
    coincidence: str = ""  # why a jump in time cannot be told from an error of a joint that turns back
    answers: tuple[Answer, ...] = ()  # of the questions that led here, in the order they were asked
    dictionary: Dictionary | None = None  # of all laws that were asked
    # What questions hand on to the next: the likeliest shape without a cause, where it is enough for an alarm,
    shape: Ranked | None = None
    # effects that could be named, likeliest first,
    contenders: tuple[Ranked, ...] = ()
    # the model in which none of them is among the errors that remain, where shape and contenders are scored then,
    base: LinearModel | None = None
    # the log posterior there of an unmodelled effect, of a joint or in time,
    unmodelled_log_posterior: float = -np.inf
    # effects that explain much and do not hold beside the others, and why,
    refused: Mapping[str, str] = field(default_factory=dict)
    # and the evidence as it was before what it names was tested.
    proposed: "Evidence | None" = None

    @cached_property
    def verdict(self) -> Verdict:
        """The first row of the table in docs/diagnosis.md ("The verdict") whose condition holds."""
        without_rival = not (self.unmodelled_explains_it or self.refuted or scanner_explains_it(self))
        if self.explanation and without_rival:
            has_rival = len(self.explanation) > 1 or self.rival_laws or self.rival_trend
            return "cannot_tell" if has_rival else "missing_effect"
        scanner_errs = self.scanner_error is not None and self.scanner_error.over_noise
        unexplained = self.alarm or self.repeating_errors or self.implausible_scatter or self.beyond_expected
        return "unknown_effect" if unexplained or scanner_errs or self.overlap_misfit > 0 else "adequate"

    @property
    def reported_laws(self) -> tuple[Ranked, ...]:
        """Laws of the dictionary that are reported.

        If something is named, they are its rivals. Otherwise they are the best law, if it stands out, and all within
        20 to 1 of it; more than `MOST_LAWS` would help nobody, and none is reported.
        """
        if self.named:
            return self.rival_laws
        if self.verdict != "unknown_effect" or not self.laws or not stands_out(self.laws[0]):
            return ()
        least = self.laws[0].log_posterior - limits.ODDS
        near = tuple(r for r in self.laws if r.log_posterior > least)
        return near if len(near) <= limits.MOST_LAWS else ()

    @property
    def reported_places(self) -> tuple[str, ...]:
        """Places of the laws within 20 to 1 of the best, where these laws are too many to be reported themselves.

        () if there are also too many places.
        """
        if self.verdict != "unknown_effect" or self.reported_laws or not self.laws or not stands_out(self.laws[0]):
            return ()
        least = self.laws[0].log_posterior - limits.ODDS
        places = dict.fromkeys(law_of(r).place.name for r in self.laws if r.log_posterior > least)
        return tuple(places) if len(places) <= limits.MOST_LAWS else ()

    @property
    def named(self) -> tuple[Ranked, ...]:
        """The effect that is missing, or the group that these views cannot tell apart; () where nothing is named."""
        return self.explanation if self.verdict in ("missing_effect", "cannot_tell") else ()

    @property
    def second(self) -> Ranked | None:
        """The effect that is missing beside the first; None where nothing is named."""
        return self.further if self.named else None

    @property
    def missing_together(self) -> tuple[str, ...]:
        """The effects that are missing side by side, the named one first; otherwise the effects that are named."""
        named, together = (tuple(r.name for r in effects) for effects in (self.named, self.together))
        return together if self.verdict == "missing_effect" and together[:1] == named else named

    @property
    def log_odds_over_nothing(self) -> float:
        """Log odds of the name, or of one of the group, over nothing being missing; infinite where none is given."""
        odds = [r.log_odds_over_nothing for r in self.named]
        return float(logsumexp(odds)) if odds else np.inf


def scanner_explains_it(evidence: Evidence) -> bool:
    """Return whether smooth errors of the scans explain at least as much as the one effect that would be named.

    Both are log Bayes factors, in nats. Errors of scans also displace poses found from them, so that an effect of the
    poses may only imitate them.
    """
    return (
        evidence.scanner_error is not None
        and len(evidence.explanation) == 1
        and evidence.scanner_error.gain >= evidence.explanation[0].score.log_bayes_factor
    )

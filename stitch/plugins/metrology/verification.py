"""An artefact that no fit has seen judges a model: its numbers, their U, and the hand-eye that its views show.

The quantities are those of VDI/VDE 2634 part 3 and ISO 10360-13: probing error of form (the band of 95 % of the points
of a sphere) and of size, and errors of distances. Only in the manner of both: they are for scanners that position
themselves, or that are positioned by their own markers; a scanner on an arm errs by its arm, and the places and number
of spheres that these prescribe are nobody's duty here.

Register moves each view to where surfaces agree: most numbers of a stitched artefact hold little of the hand-eye. So
each number says what it answers to, and the hand-eye is held against the one that the views of the artefact show.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from stitch.numerics.frames import Array
from stitch.plugins.metrology import error_sources
from stitch.plugins.metrology.budget import COVERAGE_FACTOR, MeasuredFeatures, Number
from stitch.run_data import FOUND_FROM, HandEyeTransfer, RunData
from stitch.system.values import Table

VERIFY_FORMAT = "stitch-verify/1"
# |E_n| up to 1 agrees (ISO 13528). So few that agree by chance in one case of a hundred say that U does not hold; how
# often that is these draws say, since numbers of one run err together. A single number fails where chance lets the
# largest of all be as large as seldom.
_CHANCE, _DRAWS = 0.01, 20_000
# A limit is kept, or exceeded, where that is as probable (JCGM 106, 7.3; ISO 14253-1 states the same probability).
_CONFORMITY = 0.95
# A number answers to what brings this share of its variance: an error of five times its U would move it by U.
_ANSWERING_SHARE = 0.04
HAND_EYE, ARM, SCANNER = ANSWERS = ("hand_eye", "arm", "scanner")
_ANSWERS_TO = {
    error_sources.OTHER_RUN: HAND_EYE,
    error_sources.UNSEEN: HAND_EYE,
    error_sources.OTHER_ARM: ARM,
    error_sources.SCATTER: ARM,
    error_sources.ARM: ARM,
    error_sources.WANDERING: ARM,
    error_sources.STOP: ARM,
    error_sources.SCANNER: SCANNER,
    error_sources.INCIDENCE: SCANNER,
    error_sources.SCAN: SCANNER,
}
# By kind of feature the name of the error of its first number.
_ERRORS = {"sphere": "size", "cylinder": "size", "circle": "size", "distance": "distance"}
_LENGTHS = ("size", "distance")
# Keys of the certificate that are called as the fields that they hold.
_OF_HAND_EYE = ("distance", "turn", "ratio", "U", "U_given", "p_value")
_OF_NUMBERS = ("error", "calibrated", "U_calibrated", "deviation", "E_n", "E_n_limit", "limit", "passes")


@dataclass(frozen=True)
class VerifiedNumber:
    """One calibrated number against its measurement; lengths in length_unit."""

    number: Number
    error: str  # form | size | distance | place
    calibrated: float
    U_calibrated: float
    limit: float | None  # largest permissible error
    E_n_limit: float  # that chance lets the largest |E_n| of all numbers exceed in one case of a hundred

    @property
    def deviation(self) -> float:
        """Measured less calibrated."""
        return self.number.value - self.calibrated

    @property
    def U(self) -> float:
        """Expanded uncertainty of the deviation."""
        return max(float(np.hypot(self.number.U, self.U_calibrated)), 1e-300)

    @property
    def E_n(self) -> float:
        """The deviation over its expanded uncertainty."""
        return self.deviation / self.U

    @property
    def passes(self) -> bool | None:
        """True if it agrees and its limit is kept, False if either fails, None where U is too large to decide."""
        if abs(self.E_n) > self.E_n_limit:
            return False
        if self.limit is None:
            return True
        sigma = self.U / COVERAGE_FACTOR
        within = float(ndtr((self.limit - self.deviation) / sigma) - ndtr((-self.limit - self.deviation) / sigma))
        if within >= _CONFORMITY:
            return True
        return False if within <= 1 - _CONFORMITY else None

    @property
    def answers_to(self) -> tuple[str, ...]:
        """Which errors would show in it: of hand-eye, arm and scanner (every length answers to a scanner's scale)."""
        shares = dict.fromkeys(ANSWERS, 0.0)
        for source, share in self.number.shares.items():
            if source in _ANSWERS_TO:
                shares[_ANSWERS_TO[source]] += share
        if self.error in _LENGTHS:
            shares[SCANNER] = 1.0
        return tuple(name for name, share in shares.items() if share >= _ANSWERING_SHARE)


@dataclass(frozen=True)
class FormError:
    """Width of the band of 95 % of the points about a fitted sphere, plane or cylinder, length_unit."""

    feature: str
    form: float
    limit: float | None

    @property
    def passes(self) -> bool:
        """True if it lies within its limit, if there is one."""
        return self.limit is None or self.form <= self.limit


@dataclass(frozen=True, eq=False)
class Verification(Table, document="stitch.plugins.metrology.verification:verification_document", table="numbers"):
    """Verdict of an artefact on a model.

    Example:
        >>> stitch.verify(run, artefact, plate).sentences[1]
        '... of ... calibrated numbers agree within U.'
    """

    numbers: tuple[VerifiedNumber, ...]
    forms: tuple[FormError, ...]
    hand_eye: HandEyeTransfer
    length_unit: str
    not_measured: dict[str, str]  # features without numbers, and why
    correlation: Array  # (n, n) of the deviations of the numbers

    @property
    def agreeing(self) -> int:
        """Numbers with |E_n| ≤ 1."""
        return agreeing(self.numbers)

    @property
    def U_holds(self) -> bool:
        """True if no fewer numbers agree, and none lies farther off, than chance lets, if U covers 95 %."""
        off = len(self.numbers) - self.agreeing
        values, vectors = np.linalg.eigh(self.correlation)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        E_n = np.random.default_rng(0).standard_normal((_DRAWS, len(root))) @ root.T / COVERAGE_FACTOR
        enough = np.mean((np.abs(E_n) > 1).sum(axis=1) >= off) > _CHANCE
        return bool(enough) and all(abs(n.E_n) <= n.E_n_limit for n in self.numbers)

    @property
    def answers_to(self) -> tuple[str, ...]:
        """Which errors of the cell this verification would have shown."""
        shown = {name for number in self.numbers for name in number.answers_to}
        shown |= {HAND_EYE} if self.hand_eye.decides else set()
        return tuple(name for name in ANSWERS if name in shown)

    @property
    def passed(self) -> bool | None:
        """True if all is kept and the hand-eye was put to the test, False if anything fails, None if undecided."""
        verdicts = [n.passes for n in self.numbers] + [form.passes for form in self.forms]
        verdicts += [self.U_holds, self.hand_eye.holds]
        if False in verdicts:
            return False
        decided = None not in verdicts and not self.not_measured and HAND_EYE in self.answers_to
        return True if decided else None

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict for people, and what it rests on, one fact each."""
        heading = {True: "The artefact passes.", False: "The artefact fails.", None: "Pass or fail cannot be decided."}[
            self.passed
        ]
        facts = [heading, f"{self.agreeing} of {len(self.numbers)} calibrated numbers agree within U."]
        far = [n for n in self.numbers if abs(n.E_n) > n.E_n_limit]
        if far:
            worst = max(far, key=lambda n: abs(n.E_n))
            name = worst.number.feature.name
            facts.append(f"{name} is off by {abs(worst.E_n):.1f} times U; chance lets {worst.E_n_limit:.1f}.")
        elif not self.U_holds:
            facts.append("U is too small: fewer numbers agree than chance lets.")
        beyond = [n for n in self.numbers if n.passes is False and n not in far]
        beyond_forms = [form for form in self.forms if not form.passes]
        names = [n.number.feature.name for n in beyond] + [f"form of {form.feature}" for form in beyond_forms]
        if names:
            facts.append(f"Beyond their limits: {', '.join(names)}.")
        open_numbers = [n for n in self.numbers if n.passes is None]
        if open_numbers:
            worst = max(open_numbers, key=lambda n: n.U)
            more = f" and {len(open_numbers) - 1} more" if len(open_numbers) > 1 else ""
            facts.append(
                f"U is too large for the limit of {worst.number.feature.name}{more}: "
                f"{worst.deviation:+.2g} ± {worst.U:.2g} {self.length_unit} beside {worst.limit:g}."
            )
        if self.not_measured:
            facts.append(f"Not measured: {', '.join(self.not_measured)}.")
        facts.append(self.hand_eye.sentence(self.length_unit))
        if HAND_EYE not in self.answers_to:
            facts.append(
                f"These views would not show a hand-eye that is off by {FOUND_FROM * self.hand_eye.U_given:.2g} "
                f"{self.length_unit}; to fix: turn the scanner more between views."
            )
        return tuple(facts)


def verify(measured: MeasuredFeatures, limits: dict[str, float] | None, hand_eye: HandEyeTransfer) -> Verification:
    """Judge measured features by their calibrated values, and the hand-eye by what the views show.

    Args:
        limits: largest permissible errors of form, size, distance and place; what has none is judged by E_n.
        hand_eye: the model's against the one that the views of the artefact show.
    """
    limits = limits or {}
    forms = [
        FormError(fit.feature.name, fit.form, limits.get("form"))
        for fit in measured.fits
        if fit.feature.kind in ("sphere", "plane", "cylinder")
    ]
    verified = verified_numbers(measured, limits)
    at = [next(i for i, number in enumerate(measured.numbers) if number is v.number) for v in verified]
    U = np.array([v.U for v in verified])
    correlation = COVERAGE_FACTOR**2 * measured.covariance[np.ix_(at, at)] / np.outer(U, U)
    # What the laboratory errs by is a number's own.
    np.fill_diagonal(correlation, 1.0)
    return Verification(verified, tuple(forms), hand_eye, measured.length_unit, measured.not_measured, correlation)


def verified_numbers(
    measured: MeasuredFeatures, limits: Mapping[str, float] | None = None
) -> tuple[VerifiedNumber, ...]:
    """Return the first number of each calibrated feature against its calibrated value."""
    limits = limits or {}
    first = dict[str, Number]()
    for number in measured.numbers:
        first.setdefault(number.feature.name, number)
    calibrated = [number for number in first.values() if number.feature.calibrated is not None]
    largest = largest_E_n(len(calibrated))
    verified = []
    for number in calibrated:
        error = _ERRORS.get(number.feature.kind, "place")
        value = number.feature.calibrated
        assert value is not None
        verified.append(VerifiedNumber(number, error, value, number.feature.calibrated_U, limits.get(error), largest))
    return tuple(verified)


def agreeing(numbers: Sequence[VerifiedNumber]) -> int:
    """Return how many numbers have |E_n| ≤ 1."""
    return sum(abs(n.E_n) <= 1 for n in numbers)


def largest_E_n(count: int) -> float:
    """Return the |E_n| that the largest of so many independent numbers exceeds in one case of a hundred, at least 1.

    With U = 2 σ, E_n is half a standard normal number (Šidák 1967, J. Am. Stat. Assoc. 62:626).
    """
    share = (1 - _CHANCE) ** (1 / max(count, 1))
    return max(1.0, float(ndtri((1 + share) / 2)) / COVERAGE_FACTOR)


def verification_document(
    result: Verification,
    state: RunData | None = None,
    run: str = "",
    session: str = "",
    valid_until: str | None = None,
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Return certificate.json.

    Args:
        state: the artefact's session stitched under the model: its doubts, notes and views left out stand there too.
    """
    hand_eye = result.hand_eye
    doubts, notes_of_run, left_out = ((), (), ()) if state is None else (state.doubts, state.notes, state.left_out)
    return {
        "format": VERIFY_FORMAT,
        "run": run,
        "session": session,
        "length_unit": result.length_unit,
        "k": COVERAGE_FACTOR,
        "passed": result.passed,
        "sentence": " ".join(result.sentences),
        "answers_to": list(result.answers_to),
        "U_holds": result.U_holds,
        "agreeing": result.agreeing,
        "hand_eye": {"agrees": hand_eye.holds} | {key: getattr(hand_eye, key) for key in _OF_HAND_EYE},
        "numbers": [
            {
                "feature": n.number.feature.name,
                "measured": n.number.value,
                "U": n.number.U,
                "answers_to": list(n.answers_to),
            }
            | {key: getattr(n, key) for key in _OF_NUMBERS}
            for n in result.numbers
        ],
        "forms": [
            {"feature": f.feature, "form_95": f.form, "limit": f.limit, "passes": f.passes} for f in result.forms
        ],
        "not_measured": result.not_measured,
        "doubts": list(doubts),
        "notes": [*notes_of_run, *notes],
        "left_out": [{"view": item.view, "why": item.why} for item in left_out],
        "valid_until": valid_until,
        "conditional_on": list(error_sources.NOT_INCLUDED),
        "in_the_manner_of": ["VDI/VDE 2634 part 3", "ISO 10360-13"],
    }

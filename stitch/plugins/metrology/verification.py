"""An artefact that no fit has seen judges a model: errors of form, size and distance, E_n, and whether U covers them.

The quantities are those of VDI/VDE 2634 part 3 and ISO 10360-13: probing error of form (the band of 95 % of the points
of a sphere) and of size, and errors of distances. Only in the manner of both: they are for scanners that position
themselves, or that are positioned by their own markers; a scanner on an arm errs by its arm, and the places and number
of spheres that these prescribe are nobody's duty here.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stitch.numerics.distributions import binomial_tail
from stitch.plugins.metrology.budget import COVERAGE_FACTOR, MeasuredFeatures, Number
from stitch.plugins.metrology.error_sources import NOT_INCLUDED

VERIFY_FORMAT = "stitch-verify/1"
# |E_n| up to 1 agrees (ISO 13528); of numbers of which 95 % should agree, so few by chance in one case of a hundred
# say that U does not hold.
_COVERAGE, _CHANCE = 0.95, 0.01
# By kind of feature the name of the error of its first number.
_ERRORS = {"sphere": "size", "cylinder": "size", "circle": "size", "distance": "distance"}


@dataclass(frozen=True)
class VerifiedNumber:
    """One calibrated number against its measurement; lengths in length_unit."""

    number: Number
    error: str  # form | size | distance | place
    calibrated: float
    U_calibrated: float
    limit: float | None  # largest permissible error

    @property
    def deviation(self) -> float:
        """Measured less calibrated."""
        return self.number.value - self.calibrated

    @property
    def E_n(self) -> float:
        """The deviation over the expanded uncertainty of the difference."""
        return self.deviation / max(float(np.hypot(self.number.U, self.U_calibrated)), 1e-300)

    @property
    def passes(self) -> bool:
        """Whether it lies within its limit, or agrees where there is none."""
        return abs(self.E_n) <= 1 if self.limit is None else abs(self.deviation) <= self.limit


@dataclass(frozen=True)
class FormError:
    """Width of the band of 95 % of the points about a fitted sphere, plane or cylinder, length_unit."""

    feature: str
    form: float
    limit: float | None

    @property
    def passes(self) -> bool:
        """Whether it lies within its limit, if there is one."""
        return self.limit is None or self.form <= self.limit


@dataclass(frozen=True)
class Verification:
    """What an artefact says of a model."""

    numbers: tuple[VerifiedNumber, ...]
    forms: tuple[FormError, ...]
    length_unit: str

    @property
    def agreeing(self) -> int:
        """Numbers with |E_n| ≤ 1."""
        return sum(abs(n.E_n) <= 1 for n in self.numbers)

    @property
    def U_holds(self) -> bool:
        """Whether no fewer numbers agree than chance lets, if U covers 95 %."""
        off = len(self.numbers) - self.agreeing
        return binomial_tail(off, len(self.numbers), 1 - _COVERAGE) > _CHANCE

    @property
    def passed(self) -> bool:
        """Whether every limit is kept and U holds."""
        kept = [n.passes for n in self.numbers if n.limit is not None] + [form.passes for form in self.forms]
        return all(kept) and self.U_holds

    @property
    def sentence(self) -> str:
        """The verdict for people."""
        beyond = sum(not n.passes for n in self.numbers if n.limit is not None) + sum(not f.passes for f in self.forms)
        told = f"{self.agreeing} of {len(self.numbers)} calibrated numbers agree within U."
        if beyond:
            many = "errors exceed their limits" if beyond > 1 else "error exceeds its limit"
            return f"The artefact fails: {beyond} {many}. {told}"
        return f"The artefact passes. {told}" if self.U_holds else f"The artefact fails: U is too small. {told}"


def verify(found: MeasuredFeatures, limits: dict[str, float] | None) -> Verification:
    """Judge measured features by their calibrated values.

    Args:
        limits: largest permissible errors of form, size and distance; what has none is judged by E_n.
    """
    limits, first = limits or {}, dict[str, Number]()
    for number in found.numbers:
        first.setdefault(number.feature.name, number)
    numbers = []
    for number in first.values():
        feature = number.feature
        if feature.calibrated is not None:
            error = _ERRORS.get(feature.kind, "place")
            U = feature.calibrated_U
            numbers.append(VerifiedNumber(number, error, feature.calibrated, U, limits.get(error)))
    forms = [
        FormError(fit.feature.name, fit.form, limits.get("form"))
        for fit in found.fits
        if fit.feature.kind in ("sphere", "plane", "cylinder")
    ]
    return Verification(tuple(numbers), tuple(forms), found.length_unit)


def verification_document(result: Verification, run: str, session: str, valid_until: str | None) -> dict[str, Any]:
    """Return certificate.json."""
    return {
        "format": VERIFY_FORMAT,
        "run": run,
        "session": session,
        "length_unit": result.length_unit,
        "k": COVERAGE_FACTOR,
        "passed": result.passed,
        "sentence": result.sentence,
        "U_holds": result.U_holds,
        "agreeing": result.agreeing,
        "numbers": [
            {
                "feature": n.number.feature.name,
                "error": n.error,
                "measured": n.number.value,
                "U": n.number.U,
                "calibrated": n.calibrated,
                "U_calibrated": n.U_calibrated,
                "deviation": n.deviation,
                "E_n": n.E_n,
                "limit": n.limit,
                "passes": n.passes,
            }
            for n in result.numbers
        ],
        "forms": [
            {"feature": f.feature, "form_95": f.form, "limit": f.limit, "passes": f.passes} for f in result.forms
        ],
        "valid_until": valid_until,
        "conditional_on": list(NOT_INCLUDED),
        "in_the_manner_of": ["VDI/VDE 2634 part 3", "ISO 10360-13"],
    }

"""The verdict is the table of docs/diagnosis.md, read row by row."""

from types import SimpleNamespace

import pytest

from stitch.diagnosis.verdict import Evidence
from stitch.observations.surfaces.field_error import FieldError

ONE, OTHER = (SimpleNamespace(name=n, score=SimpleNamespace(log_bayes_factor=8.0)) for n in ("backlash", "settling"))
LARGE, SMALL = (FieldError(0.02, 0.0, gain, over_noise) for gain, over_noise in ((20.0, True), (5.0, False)))
REPEATS = (SimpleNamespace(words="wander"),)


@pytest.mark.parametrize(
    ("verdict", "evidence"),
    [
        ("missing_effect", {"alarm": True, "explanation": (ONE,)}),
        ("missing_effect", {"alarm": True, "explanation": (ONE,), "scanner_error": SMALL, "overlap_misfit": 0.1}),
        ("missing_effect", {"alarm": True, "explanation": (ONE,), "implausible_scatter": True}),
        ("cannot_tell", {"alarm": True, "explanation": (ONE, OTHER)}),
        ("cannot_tell", {"explanation": (ONE, OTHER)}),
        ("unknown_effect", {"alarm": True}),
        ("unknown_effect", {"alarm": True, "explanation": (ONE,), "unmodelled_explains_it": True}),
        ("unknown_effect", {"alarm": True, "explanation": (ONE,), "refuted": True}),
        ("unknown_effect", {"alarm": True, "explanation": (ONE,), "scanner_error": LARGE}),
        ("unknown_effect", {"repeating_errors": REPEATS}),
        ("unknown_effect", {"implausible_scatter": True}),
        ("unknown_effect", {"scanner_error": LARGE}),
        ("unknown_effect", {"overlap_misfit": 0.1}),
        ("adequate", {"repeating_errors": (), "scanner_error": SMALL}),
        ("adequate", {}),
    ],
)
def test_each_row_of_the_table(verdict, evidence):
    found = Evidence((), (), **evidence)
    assert found.verdict == verdict
    assert found.named == (evidence["explanation"] if verdict in ("missing_effect", "cannot_tell") else ())


def test_a_second_effect_goes_with_the_first():
    pair = {"alarm": True, "explanation": (ONE,), "further": OTHER}
    assert Evidence((), (), **pair).second is OTHER
    assert Evidence((), (), **pair, refuted=True).second is None

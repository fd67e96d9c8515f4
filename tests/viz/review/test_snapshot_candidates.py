"""A diagnosis as the review shows it."""

import pytest

from viz.review.run_snapshot import told_diagnosis

EVIDENCE = "backlash is missing (b5 = 0.0004 rad)."


@pytest.mark.parametrize(
    "document, told",
    [
        ({"plain": "Missing in the model: backlash."}, ("Missing in the model: backlash.", EVIDENCE)),
        # Written before there was a sentence for everybody.
        ({}, (EVIDENCE, "")),
    ],
)
def test_no_sentence_stands_twice(document, told):
    found = told_diagnosis({"verdict": "missing_effect", "effects": ["backlash"], "sentence": EVIDENCE} | document, 1e3)
    assert (found["plain"], found["sentence"]) == told

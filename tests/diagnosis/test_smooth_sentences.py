"""What is said of scans that err smoothly: the clearer of the two kinds first, and never in place of the poses."""

import pytest

from stitch.diagnosis.sentences import scanner_clause_before_poses, scanner_clause_if_adequate, scanner_error_sentence
from stitch.observations.surfaces.scanner_errors import FieldError

SAME = FieldError(0.02, 0.0, 9.0, over_noise=False)
BOTH = FieldError(0.02, 0.01, 9.0, over_noise=True, with_time=True)
OWN = FieldError(0.0, 0.03, 9.0, over_noise=True, by_view=True)


@pytest.mark.parametrize("said", [scanner_clause_if_adequate, scanner_clause_before_poses, scanner_error_sentence])
def test_the_clearer_kind_is_said_with_its_size(said):
    assert "20 µm" in said(SAME, "mm") and "the same in every view" in said(SAME, "mm")
    assert "by itself" not in said(SAME, "mm")
    both = said(BOTH, "mm")
    assert "the same in every view" in both and "in part every view by itself, as the session goes on" in both
    assert "30 µm" in said(OWN, "mm") and "every view by itself" in said(OWN, "mm") and "same" not in said(OWN, "mm")


def test_nothing_is_said_of_usual_scans():
    assert scanner_clause_if_adequate(None, "mm") == scanner_clause_before_poses(None, "mm") == ""
    # Named by the views' poses alone: without a size.
    assert "rms" not in scanner_error_sentence(None, "mm")

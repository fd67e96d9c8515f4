"""What is said of scans that err smoothly: the clearer of the two kinds, with its size."""

from stitch.diagnosis.sentences import scanner_advice, scanner_error_sentence
from stitch.observations.surfaces.field_error import FieldError

SAME = FieldError(0.02, 0.0, 9.0, over_noise=False)
BOTH = FieldError(0.02, 0.01, 9.0, over_noise=True, with_time=True)
OWN = FieldError(0.0, 0.03, 9.0, over_noise=True, by_view=True)


def test_the_clearer_kind_is_said_with_its_size():
    same, both, own = (scanner_error_sentence(found, "mm") for found in (SAME, BOTH, OWN))
    assert "the same in every view: 20 µm" in same and "by itself" not in same
    assert "the same in every view" in both and "each view errs by itself, larger as the session goes on" in both
    assert "of its own: 30 µm" in own and "same" not in own


def test_what_the_poses_alone_show_has_no_size():
    assert "rms" not in " ".join(scanner_advice(None, "mm"))
    assert "20 µm rms" in " ".join(scanner_advice(SAME, "mm"))
    assert "again at the end" in " ".join(scanner_advice(OWN, "mm"))

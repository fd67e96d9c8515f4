"""model.toml that was edited by hand."""

import numpy as np
import pytest

from data_synth.fixtures.edits import edit
from stitch.errors import InputError
from stitch.model.model_toml import ModelFile, read_model, write_model


@pytest.mark.parametrize(("old", "new", "expected"), [
    ('length_unit = "mm"', 'length_unit = "cm"', "length_unit is 'cm'"), ('length_unit = "mm"\n', "", "length_unit is None"),
    ("^", "effects_file = 5\n", "effects_file is 5"),
])  # fmt: skip
def test_a_model_that_was_edited_wrongly_is_refused(tmp_path, old, new, expected):
    file = tmp_path / "model.toml"
    write_model(ModelFile("mm", "eye_to_hand", np.eye(4), np.eye(4), np.eye(6)), file)
    edit(file, old, new)
    with pytest.raises(InputError, match=f"model.toml: {expected}; "):
        read_model(file)

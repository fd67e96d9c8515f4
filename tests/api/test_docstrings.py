"""Every public name says shapes, units, frames and errors, and its example is run."""

import doctest
from dataclasses import replace

import numpy as np
import pytest

import stitch
from stitch.measurement.session import Cloud

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
METHODS = ("Session.from_arrays", "Session.save", "Run.save")


def docstring(name):
    """Of a public name, or of a method of one."""
    owner, _, method = name.partition(".")
    found = getattr(stitch, owner)
    return (getattr(found, method) if method else found).__doc__


def moved(view):
    """The view as if it had been scanned once more."""
    return replace(view, cloud=Cloud(view.cloud.points + 1e-6, None, view.cloud.scalars))


@pytest.fixture(scope="module")
def names_of_examples(arrays, cell_folder, loaded, found):
    """What the examples call as a person would, but for the folder to write into."""
    clouds, poses = arrays
    return {
        "stitch": stitch,
        "np": np,
        "replace": replace,
        "clouds": clouds,
        "poses": poses,
        "session": loaded,
        "other": replace(loaded, name="other", views=tuple(moved(view) for view in loaded.views)),
        "session_folder": cell_folder,
        "run": found,
        "better": stitch.add(found, "range_scale"),
    }


@pytest.mark.parametrize("name", [*stitch.__all__, *METHODS])
def test_the_example_gives_what_it_says(name, names_of_examples, tmp_path):
    text = docstring(name)
    globs = names_of_examples | {"folder": tmp_path}
    example = doctest.DocTestParser().get_doctest(text, globs, name, None, None)
    assert example.examples, f"{name} has no example"
    said = []
    doctest.DocTestRunner(optionflags=FLAGS).run(example, out=said.append)
    assert not said, "".join(said)


@pytest.mark.parametrize("name", [n for n in stitch.__all__ if n[0].islower()] + ["Session.from_arrays"])
def test_a_function_says_what_it_raises_and_in_which_units(name):
    text = docstring(name)
    assert "Raises:" in text and "Example:" in text
    assert any(word in text for word in ("(4, 4)", "(V,", "(N, 3)", "length_unit", "rad", "mm")), name

"""Every public name, and whatever one reaches from it, says shapes, units, frames and errors; its example is run."""

import ast
import doctest
import inspect
import re
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pytest

import stitch
from stitch.session.session import Cloud
from tests.needs import needs_open3d

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
# How a method begins that returns what it did.
VERBS = {"Return", "Write", "Take", "Run"}
ERRORS = {"InputError", "NoResultError"}


def classes_in(hint):
    """Classes of stitch in a type."""
    own = {hint} if inspect.isclass(hint) and hint.__module__.startswith("stitch.") else set()
    return own.union(*map(classes_in, get_args(hint)))


def returned(member):
    """Classes of stitch that a function, method or property returns."""
    function = getattr(member, "fget", None) or getattr(member, "func", None) or getattr(member, "__func__", member)
    return classes_in(get_type_hints(function).get("return")) if inspect.isfunction(function) else set()


def held():
    """The public classes, and whatever one reaches from public functions by methods and properties."""
    public = [getattr(stitch, name) for name in stitch.__all__]
    waiting = [kind for kind in public if inspect.isclass(kind) and not issubclass(kind, Exception)]
    waiting += sorted(set().union(*map(returned, public)), key=lambda kind: kind.__name__)
    found = []
    while waiting:
        kind = waiting.pop(0)
        # Of a class and the one that people hold in its place the second counts.
        if any(issubclass(other, kind) for other in found):
            continue
        found.append(kind)
        waiting += sorted(set().union(*map(returned, members(kind).values())), key=lambda kind: kind.__name__)
    return found


def members(kind):
    """Public members of a class, own and inherited, by the name under which people call them."""
    names = [name for name in dir(kind) if not name.startswith("_")]
    return {f"{kind.__name__}.{name}": inspect.getattr_static(kind, name) for name in names}


HELD = held()
MEMBERS = {name: member for kind in HELD for name, member in members(kind).items()}
METHODS = {name: f for name, m in MEMBERS.items() if inspect.isfunction(f := getattr(m, "__func__", m))}
PROPERTIES = {name: m for name, m in MEMBERS.items() if isinstance(m, property | cached_property)}
CLASSES = {kind.__name__: kind for kind in HELD}
FUNCTIONS = {name: getattr(stitch, name) for name in stitch.__all__ if inspect.isfunction(getattr(stitch, name))}
NAMES = {name: getattr(stitch, name) for name in stitch.__all__} | CLASSES | METHODS


def example_of(name, globs=None):
    """The example of a public name, with what it finds there."""
    return doctest.DocTestParser().get_doctest(inspect.getdoc(NAMES[name]), globs or {}, name, None, None)


def moved(view):
    """The view as if it had been scanned once more."""
    return replace(view, cloud=Cloud(view.cloud.points + 1e-6, None, view.cloud.scalars))


@pytest.fixture(scope="module")
def names_of_examples(arrays, cell_folder, loaded, found, better):
    """What the examples call as a person would, but for the folder to write into."""
    clouds, poses = arrays
    grown = stitch.live(mount="eye_in_hand")
    for cloud, pose in zip(clouds, poses, strict=True):
        grown.add_view(cloud, pose)
    # What takes seconds is done once, for all examples that ask for it.
    slow = {name: cache(getattr(stitch, name)) for name in ("compare", "diagnose", "plan")}
    return {
        "stitch": SimpleNamespace(**{name: getattr(stitch, name) for name in stitch.__all__} | slow),
        "np": np,
        "replace": replace,
        "clouds": clouds,
        "poses": poses,
        "session": loaded,
        "other": replace(loaded, name="other", views=tuple(moved(view) for view in loaded.views)),
        "session_folder": cell_folder,
        "run": found,
        "better": better,
        "live": grown,
    }


@pytest.mark.parametrize("name", NAMES)
def test_every_name_has_an_example(name):
    assert example_of(name).examples


# Ten seconds: a plan looks at forty views.
PLANS = [name for name in NAMES if any("stitch.plan(" in own.source for own in example_of(name).examples)]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in PLANS)) for name in NAMES], ids=str
)
def test_the_example_gives_what_it_says(name, names_of_examples, tmp_path):
    if "open3d" in name:
        needs_open3d()
    said = []
    example = example_of(name, names_of_examples | {"folder": tmp_path})
    doctest.DocTestRunner(optionflags=FLAGS).run(example, out=said.append)
    assert not said, "".join(said)


@pytest.mark.parametrize("name", [*FUNCTIONS, "Session.from_arrays"])
def test_a_function_says_what_it_raises_and_in_which_units(name):
    text = NAMES[name].__doc__
    assert "Raises:" in text and "Example:" in text
    assert any(word in text for word in ("(4, 4)", "(V,", "(N, 3)", "length_unit", "rad", "mm")), name


@pytest.mark.parametrize("name", METHODS)
def test_a_method_begins_with_what_it_does_and_says_what_it_raises(name):
    text = inspect.getdoc(METHODS[name])
    assert text.split()[0] in VERBS
    assert "Raises:" in text or not refuses(METHODS[name].__name__)


@pytest.mark.parametrize("name", PROPERTIES)
def test_a_property_says_what_it_is_and_what_it_raises(name):
    text = PROPERTIES[name].__doc__
    assert text and re.match(r"[A-Z(`]", text)
    assert "Raises:" in text or not refuses(name.split(".")[1])


def calls_and_refusals():
    """Of every function of the rooms that people call: names that it calls, and whether it raises itself."""
    root = Path(stitch.__file__).parent
    files = [*(root / "api").glob("*.py"), root / "system" / "open3d_library.py"]
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
    out = {}
    for node in (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        inside = list(ast.walk(node))
        called = {ast.unparse(n.func).split(".")[-1] for n in inside if isinstance(n, ast.Call)}
        raised = any(isinstance(n, ast.Raise) and n.exc and ast.unparse(n.exc).split("(")[0] in ERRORS for n in inside)
        # Of several of one name all count.
        before, refused = out.get(node.name, (set(), False))
        out[node.name] = before | called, refused or raised
    return out


CALLS = calls_and_refusals()


def refuses(name, above=()):
    """True if a function, or one that it calls there, raises InputError or NoResultError."""
    called, raised = CALLS.get(name, ((), False))
    return raised or any(refuses(other, (*above, name)) for other in called if other not in (*above, name))


def test_a_refusal_is_seen_through_the_functions_between():
    assert refuses("save") and refuses("to_open3d") and refuses("add_view") and not refuses("to_trimesh")

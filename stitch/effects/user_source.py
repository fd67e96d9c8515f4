"""The source of effects that a script or a notebook defined, as a file that defines them and nothing else.

A script that runs a session cannot be run again to read its run. So the file holds the effects' functions, what those
name, and imports; it is executed once, and what it defines has to be the effects again.
"""

import ast
import builtins
import inspect
import sys
import sysconfig
import textwrap
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from stitch.effects.contract import EFFECTS, Effect
from stitch.errors import InputError

# What a run folder calls the file.
EFFECTS_FILE = "model_effects.py"
_HEADER = '"""Effects of a run, as the program defined them that ran it."""\n'
_FIX = "to fix: write the effect into a file, and load it with stitch.effects.user_file.load"


def source_of(effects: Sequence[Effect]) -> str:
    """Return the text of a Python file that, executed alone, defines these effects: functions, imports and constants.

    Raises:
        InputError: the source of a function is not at hand, or it names what no file could hold.
    """
    imports: dict[str, None] = {}
    pieces: dict[str, str] = {}
    for effect in effects:
        function = inspect.unwrap(effect.function)
        _collect(function.__name__, function, f"effect {effect.name}", imports, pieces)
    text = "\n".join([_HEADER, *sorted(imports), "", *(f"\n{piece}" for piece in pieces.values())]).rstrip() + "\n"
    _require_same(text, effects)
    return text


def _collect(name: str, value: Any, where: str, imports: dict[str, None], pieces: dict[str, str]) -> None:
    """Add the source that defines a name to `pieces` or `imports`, and before it that of all names which it uses.

    Modules and installed objects become imports; functions and classes of the program their source; arrays and literals
    an assignment.

    Args:
        name, value: what the name stands for in the program.
        where: names the effect in a message.
        imports: import statements so far, as keys; added to.
        pieces: name -> its source so far, in the order of the file; added to.

    Raises:
        InputError: a value that no file can hold.
    """
    if name in pieces:
        return
    if isinstance(value, ModuleType):
        if not _is_installed(value):
            raise InputError(f"{where}: names {name}, a module that other programs do not find; {_FIX}")
        imports[f"import {value.__name__} as {name}"] = None
    elif isinstance(value, (FunctionType, type)) and not _is_installed(sys.modules.get(value.__module__)):
        pieces[name] = ""  # marked as begun: two functions that call each other would not end
        source = _source(name, value, where)
        known = _globals(value)
        for needed in _names(source):
            if needed != name and needed in known:
                _collect(needed, known[needed], where, imports, pieces)
        del pieces[name]
        pieces[name] = f"\n{source}"
    elif callable(value) and hasattr(value, "__qualname__"):
        known_as = str(getattr(value, "__qualname__", ""))
        if getattr(import_module(value.__module__), known_as, None) is not value:
            raise InputError(f"{where}: {name} cannot be imported from {value.__module__}; {_FIX}")
        imports[f"from {value.__module__} import {known_as} as {name}"] = None
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and np.isfinite(value).all():
        imports["import numpy"] = None
        pieces[name] = f"{name} = numpy.array({value.tolist()!r}, numpy.{value.dtype.name})"
    else:
        _require_literal(name, value, where)
        pieces[name] = f"{name} = {value!r}"


def _source(name: str, value: Any, where: str) -> str:
    """Return the source of a function or class: the one statement, a def, class or assignment, that gives it its name.

    Raises:
        InputError: there is no source, or no such statement; `where` names the effect.
    """
    try:
        source = textwrap.dedent(inspect.getsource(value)).rstrip()
        statement = ast.parse(source).body[0]
    except (OSError, TypeError, SyntaxError):
        raise InputError(
            f"{where}: the source of {name} is not at hand, and without it nobody can read the run; {_FIX}"
        ) from None
    defined = {getattr(target, "id", "") for target in getattr(statement, "targets", [])}
    if name not in {getattr(statement, "name", ""), *defined}:
        raise InputError(f"{where}: names {name}, which no def and no assignment of one line defines; {_FIX}")
    return source


def _globals(value: Any) -> dict[str, Any]:
    """Return name -> value for the names that a function or class can use: its module's, and those it encloses."""
    if isinstance(value, type):
        return vars(sys.modules[value.__module__])
    return {**value.__globals__, **inspect.getclosurevars(value).nonlocals}


def _names(source: str) -> list[str]:
    """Return the names that a source reads, in their order, without Python's own."""
    read = [node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)]
    return [name for name in dict.fromkeys(read) if not hasattr(builtins, name)]


def _is_installed(module: ModuleType | None) -> bool:
    """Return True if every program can import a module: Python's own and installed ones; not the program itself."""
    file = getattr(module, "__file__", None)
    if module is None or module.__name__ == "__main__":
        return False
    if file is None or module.__name__.partition(".")[0] == "stitch":
        return True
    paths = [Path(sysconfig.get_path(key)).resolve() for key in ("stdlib", "purelib", "platlib")]
    return any(Path(file).resolve().is_relative_to(path) for path in paths)


def _require_literal(name: str, value: Any, where: str) -> None:
    """Refuse a value that does not equal what its `repr` evaluates to, so that no source can state it.

    Args:
        name: under which a user's effect uses it.
        where: names the effect in the message.
    """
    try:
        same = bool(ast.literal_eval(repr(value)) == value)
    except (ValueError, SyntaxError, TypeError):
        same = False
    if not same:
        raise InputError(f"{where}: names {name}, a {type(value).__name__} that no file can hold; {_FIX}")


def _require_same(text: str, effects: Sequence[Effect]) -> None:
    """Refuse the text of a file that, executed alone, does not define all of the effects with the same specs.

    The registry is restored afterwards.

    Raises:
        InputError: names the effect, or the error of the file.
    """
    before = dict(EFFECTS)
    try:
        exec(compile(text, EFFECTS_FILE, "exec"), {"__name__": "stitch_user_effects"})
        fresh = [EFFECTS.get(e.name) for e in effects]
        wrong = [e.name for e, f in zip(effects, fresh, strict=True) if f is None or f is e or f.specs != e.specs]
    except Exception as error:
        raise InputError(f"effects of this program: their source fails by itself: {error}; {_FIX}") from None
    finally:
        EFFECTS.clear()
        EFFECTS.update(before)
    if wrong:
        raise InputError(f"effect {wrong[0]}: its source does not define it under @effect(place, …); {_FIX}")

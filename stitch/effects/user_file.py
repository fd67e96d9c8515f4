"""A user's own effects from a Python file, written in the form of the library's."""

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

from stitch.effects.contract import EFFECTS, Effect
from stitch.errors import InputError


def load(path: Path) -> list[str]:
    """Run the file; its effects join the registry. Returns their names.

    The file is Python and is executed: load only files that you would run.

    Raises:
        InputError: no such file, no Python file, an error in it (with its line), or no effect in it.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; --effects-file names a Python file with @effect functions")
    spec = importlib.util.spec_from_file_location(f"stitch_user_effects_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not called a Python file; rename it {path.with_suffix('.py').name}")
    before = dict(EFFECTS)
    for name in [name for name, known in EFFECTS.items() if known.tier == "user"]:
        del EFFECTS[name]
    try:
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # whatever a user's file may raise
        line = _line(error, path)
        raise InputError(f"{path}{line}: {_told(error)}") from None
    names = [name for name in EFFECTS if name not in before or EFFECTS[name] is not before[name]]
    if not names:
        raise InputError(f"{path}: no effect in it; decorate a function with @stitch.effects.effect(place, …)")
    for name in names:
        EFFECTS[name] = replace(EFFECTS[name], tier="user", function=_guarded(EFFECTS[name], path))
    return names


def _guarded(effect: Effect, path: Path) -> Callable[..., Any]:
    """The effect's function; what goes wrong in it names the file and the line."""

    @wraps(effect.function)
    def function(*args: Any, **parameters: Any) -> Any:
        try:
            return effect.function(*args, **parameters)
        except Exception as error:  # whatever a user's function may raise
            raise InputError(f"{path}{_line(error, path)}: effect {effect.name}: {_told(error)}") from None

    return function


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _line(error: Exception, path: Path) -> str:
    if isinstance(error, SyntaxError):
        return f" line {error.lineno}"
    trace, found = error.__traceback__, ""
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            found = f" line {trace.tb_lineno}"
        trace = trace.tb_next
    return found

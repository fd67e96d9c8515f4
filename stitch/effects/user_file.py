"""A user's own effects from a Python file, written in the form of the library's."""

import importlib.util
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from types import ModuleType
from typing import Any

from stitch.effects.checked import read_only_arguments, require_effect, require_result
from stitch.effects.contract import EFFECTS, Effect
from stitch.errors import InputError
from stitch.system.time_limit import time_limit

# Seconds for the file and for every call of an effect; a call on a million points takes less than one.
_SECONDS = 5.0
_LIMIT = "STITCH_EFFECT_SECONDS"


def load(path: Path) -> list[str]:
    """Run the file; its effects join the registry. Returns their names.

    The file is Python and is executed: load only files that you would run.

    Raises:
        InputError: no such file, no Python file, an error in it (with its line), or no effect in it. The registry is
            then as it was.
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
        with _name_errors(path, ""):
            _execute(path, importlib.util.module_from_spec(spec))
        names = [name for name in EFFECTS if name not in before or EFFECTS[name] is not before[name]]
        if not names:
            raise InputError(f"{path}: no effect in it; decorate a function with @stitch.effects.effect(place, …)")
        for name in names:
            require_effect(EFFECTS[name], f"{path}: effect {name}")
    except InputError:
        EFFECTS.clear()
        EFFECTS.update(before)
        raise
    for name in names:
        EFFECTS[name] = replace(EFFECTS[name], tier="user", function=_guard_function(EFFECTS[name], path))
    return names


def _execute(path: Path, module: ModuleType) -> None:
    """Run the file as it stands; Python's own import would leave a cache beside it, and may take one that is old."""
    exec(compile(path.read_bytes(), path, "exec"), vars(module))


def _guard_function(effect: Effect, path: Path) -> Callable[..., Any]:
    """The effect's function; what goes wrong in it names the file and the line, and so does a result that cannot be."""

    @wraps(effect.function)
    def function(*arguments: Any, **parameters: Any) -> Any:
        with _name_errors(path, f" effect {effect.name}:"):
            result = effect.function(*read_only_arguments(arguments), **parameters)
        return require_result(effect, arguments, result, f"{path}: effect {effect.name}")

    return function


@contextmanager
def _name_errors(path: Path, what: str) -> Iterator[None]:
    """Errors, ends of the program and endless loops in a user's file as one line."""
    seconds = _seconds()
    late = (
        f"{path}:{what} does not end within {seconds:g} s; to fix: look for a loop in it, or allow more seconds in the "
        f"environment variable {_LIMIT}"
    )
    try:
        with time_limit(seconds, late):
            yield
    except InputError as error:
        told = str(error)
        raise InputError(told if told.startswith(str(path)) else f"{path}:{what} {told}; to fix: correct it") from None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # whatever a user's file may raise, the end of the program too
        reason = "ends the program" if isinstance(error, SystemExit) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}{_error_line(error, path)}:{what} {reason}; to fix: correct it there") from None


def _seconds() -> float:
    try:
        seconds = float(os.environ.get(_LIMIT, _SECONDS))
    except ValueError:
        seconds = float("nan")
    if not seconds > 0:
        raise InputError(f"{_LIMIT} is {os.environ[_LIMIT]!r}; to fix: write a number of seconds")
    return seconds


def _error_line(error: BaseException, path: Path) -> str:
    if isinstance(error, SyntaxError):
        return "" if error.lineno is None else f" line {error.lineno}"
    trace, found = error.__traceback__, ""
    while trace is not None:
        if os.path.abspath(trace.tb_frame.f_code.co_filename) == os.path.abspath(path):
            found = f" line {trace.tb_lineno}"
        trace = trace.tb_next
    return found

"""A user's own effects from a Python file or a package, written in the form of the library's.

What the file says of an effect and what its function returns is checked; whatever goes wrong in it is one line that
names the file and the place.
"""

import importlib.util
import inspect
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np

from stitch.effects.contract import EFFECTS, Effect, Spec
from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.session.robot import Links
from stitch.system.time_limit import time_limit

_KINDS = ("number", "vector", "offset", "joint", "torque", "moment", "twist")
# Seconds for the file and for every call of an effect; a call on a million points takes less than one.
_SECONDS = 5.0
_LIMIT = "STITCH_EFFECT_SECONDS"


def load(path: Path) -> list[str]:
    """Execute a Python file, register its effects in EFFECTS, and return their names.

    They replace those of the file that was loaded before. The file can do all that Python can: load only files that you
    would run.

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
    for name in [name for name, known in EFFECTS.items() if known.origin.endswith(".py")]:
        del EFFECTS[name]
    try:
        with _name_errors(path, ""):
            # Not imported: that would leave a cache beside the file, or use one that is out of date.
            exec(compile(path.read_bytes(), path, "exec"), vars(importlib.util.module_from_spec(spec)))
        names = [name for name in EFFECTS if name not in before or EFFECTS[name] is not before[name]]
        if not names:
            raise InputError(f"{path}: no effect in it; decorate a function with @stitch.effects.effect(place, …)")
        for name in names:
            _require_effect(EFFECTS[name], f"{path}: effect {name}")
    except InputError:
        EFFECTS.clear()
        EFFECTS.update(before)
        raise
    for name in names:
        defined = EFFECTS[name]
        guarded = _guard_function(defined, path)
        EFFECTS[name] = replace(defined, tier="user", function=guarded, origin=str(path.resolve()))
    return names


def load_packages() -> None:
    """Register the effects of installed packages in EFFECTS: those of the entry-point group `stitch.effects`.

    An entry names a module, or a function without arguments, that uses @effect. An entry that fails leaves the registry
    as it was, with one warning.
    """
    for entry in entry_points(group="stitch.effects"):
        before = dict(EFFECTS)
        package = entry.dist.name if entry.dist else entry.module
        try:
            offered = entry.load()
            if callable(offered):
                offered()
            names = [name for name in EFFECTS if EFFECTS[name] is not before.get(name)]
            for name in names:
                _require_effect(EFFECTS[name], f"package {package}: effect {name}")
                EFFECTS[name] = replace(EFFECTS[name], tier="user", origin=f"package {package}")
        except Exception as error:  # whatever another's package may raise
            EFFECTS.clear()
            EFFECTS.update(before)
            reason = error if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            warnings.warn(f"package {package}: its effects are left out: {reason}; to fix: correct it", stacklevel=2)


def _require_effect(effect: Effect, where: str) -> None:
    """Refuse a user's effect with wrong specs, or whose function lacks an argument for one of them.

    Args:
        where: names file and effect at the beginning of the message.

    Raises:
        InputError: names the argument, and how to fix it.
    """
    for key, spec in effect.specs.items():
        if not isinstance(spec, Spec) or spec.kind not in _KINDS:
            raise InputError(
                f"{where}: {key} is {spec!r}; to fix: write number(…), vector(…), per_joint(…), twist(…) …"
            )
        sizes = {"typical": spec.typical, "limit": spec.limit}
        if spec.kind == "twist":
            sizes |= {"translation": spec.typical_shift, "limit_translation": spec.limit_shift}
        for name, size in sizes.items():
            if not (_is_number(size) and size > 0) or (size == np.inf and name in ("typical", "translation")):
                raise InputError(f"{where}: {name} of {key} is {size!r}; to fix: write a positive number")
        if not all(isinstance(unit, str) for unit in (spec.unit, spec.unit_shift)):
            raise InputError(f"{where}: the unit of {key} is {spec.unit!r}; to fix: write it in quotes")
        if not all(_is_number(value) and np.isfinite(value) for value in spec.grid):
            raise InputError(f"{where}: the grid of {key} is {spec.grid!r}; to fix: write finite numbers")
    if not all(isinstance(need, str) for need in (*effect.needs, *effect.prefers)):
        raise InputError(f"{where}: needs and prefers are lists of names; to fix: write them in quotes")
    taken = inspect.signature(effect.function).parameters
    if any(p.kind is p.VAR_KEYWORD for p in taken.values()):
        return
    missing = [key for key in effect.specs if key not in taken]
    if missing:
        raise InputError(f"{where}: its function has no argument {missing[0]!r}; to fix: name it as the parameter")


def _guard_function(effect: Effect, path: Path) -> Callable[..., Any]:
    """Return the effect's function wrapped: its errors become one line that names the file, and results are checked."""

    @wraps(effect.function)
    def function(*arguments: Any, **parameters: Any) -> Any:
        """Call the effect with its arrays read-only, and return its result, checked."""
        # An effect must return a changed array and leave the one that it is given: writing raises an error.
        read_only = [value.view() if isinstance(value, np.ndarray) else value for value in arguments]
        for value in read_only:
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
        with _name_errors(path, f" effect {effect.name}:"):
            result = effect.function(*read_only, **parameters)
        return _require_result(effect, arguments, result, f"{path}: effect {effect.name}")

    return function


def _require_result(effect: Effect, arguments: tuple[Any, ...], result: Any, where: str) -> Any:
    """Return the result of an effect's function, checked, as float arrays.

    Args:
        arguments: with which it was called: their shape is that of the result, or (V, 6) of twists.
        where: names file and effect at the beginning of the message.

    Raises:
        InputError: another shape than the place asks for, or values that are no real numbers.
    """
    if effect.place == "links":
        if not isinstance(result, Links):
            raise InputError(
                f"{where} returns {_describe_result(result)}; to fix: return dataclasses.replace(links, …)"
            )
        for name, given, value in zip(vars(result), vars(arguments[0]).values(), vars(result).values(), strict=True):
            _require_numbers(value, given, f"{where} returns {name} as")
        return result
    if effect.place in ("base", "mount", "part"):
        return _require_numbers(result, np.zeros((arguments[0].count, 6)), f"{where} returns")
    return _require_numbers(result, arguments[0], f"{where} returns")


def _require_numbers(result: Any, like: Array, where: str) -> Array:
    """Return a result as floats, if its shape is that of `like`, and it is finite wherever `like` is.

    Raises:
        InputError: it is not; the message begins with `where`.
    """
    try:
        values = np.asarray(result)
    except ValueError:
        values = np.empty(0)
    if values.shape != like.shape or values.dtype.kind not in "fiu":
        raise InputError(f"{where} {_describe_result(result)}; to fix: return real numbers of shape {like.shape}")
    wrong = ~np.isfinite(values) & np.isfinite(like)
    if wrong.any():
        raise InputError(f"{where} NaN or infinity in {wrong.sum()} of {values.size} numbers; to fix: keep them finite")
    return values.astype(np.float64, copy=False)


def _describe_result(result: Any) -> str:
    """Return a wrong result in words: its kind of numbers and shape, or its type."""
    if isinstance(result, np.ndarray):
        kind = {"c": "complex numbers", "O": "objects", "b": "truth values"}.get(result.dtype.kind, "an array")
        return f"{kind} of shape {result.shape}"
    return "None" if result is None else f"a {type(result).__name__}"


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, (bool, np.complexfloating))


@contextmanager
def _name_errors(path: Path, what: str) -> Iterator[None]:
    """Turn what goes wrong in a user's code, in the block, into an InputError of one line.

    Errors of any kind, SystemExit, and code that runs longer than the limit of time.

    Args:
        path: of the user's file.
        what: names the effect in the message; empty: the file itself.
    """
    seconds = _seconds()
    late = (
        f"{path}:{what} does not end within {seconds:g} s; to fix: look for a loop in it, or allow more seconds in the "
        f"environment variable {_LIMIT}"
    )
    try:
        with time_limit(seconds, late):
            yield
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}:{what} {text}; to fix: correct it") from None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # whatever a user's file may raise, the end of the program too
        reason = "ends the program" if isinstance(error, SystemExit) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}{_error_line(error, path)}:{what} {reason}; to fix: correct it there") from None


def _seconds() -> float:
    """Return the limit of time of a call of a user's effect, s: of the environment variable `_LIMIT`, else `_SECONDS`.

    Raises:
        InputError: the variable holds no positive number.
    """
    try:
        seconds = float(os.environ.get(_LIMIT, _SECONDS))
    except ValueError:
        seconds = float("nan")
    if not seconds > 0:
        raise InputError(f"{_LIMIT} is {os.environ[_LIMIT]!r}; to fix: write a number of seconds")
    return seconds


def _error_line(error: BaseException, path: Path) -> str:
    """Return " line N" for the innermost line of the file that an error passed through; empty if there is none."""
    if isinstance(error, SyntaxError):
        return "" if error.lineno is None else f" line {error.lineno}"
    trace, line = error.__traceback__, ""
    while trace is not None:
        if os.path.abspath(trace.tb_frame.f_code.co_filename) == os.path.abspath(path):
            line = f" line {trace.tb_lineno}"
        trace = trace.tb_next
    return line

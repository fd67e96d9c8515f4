"""Is what a user's file says of an effect, and what its function returns, what the chain can use?"""

import inspect
from typing import Any

import numpy as np

from stitch.effects.contract import Effect
from stitch.effects.specs import Spec
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.imperfect_arm import Links

_KINDS = ("number", "offset", "joint", "torque", "twist")


def require_effect(effect: Effect, where: str) -> None:
    """Refuse parameters without a plausible size, and a function that does not take them.

    Raises:
        InputError: with `where` in front.
    """
    for key, spec in effect.specs.items():
        if not isinstance(spec, Spec) or spec.kind not in _KINDS:
            raise InputError(
                f"{where}: {key} is {spec!r}; to fix: write number(…), offset(…), per_joint(…), twist(…) …"
            )
        sizes = {"typical": spec.typical, "limit": spec.limit}
        if spec.kind == "twist":
            sizes |= {"translation": spec.typical_shift, "limit_translation": spec.limit_shift}
        for name, size in sizes.items():
            if not _is_positive(size) or (size == np.inf and name in ("typical", "translation")):
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


def read_only_arguments(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """The arguments, arrays among them read-only: an effect returns what changes and leaves what it is given."""
    return tuple(_read_only(value) if isinstance(value, np.ndarray) else value for value in arguments)


def require_result(effect: Effect, arguments: tuple[Any, ...], result: Any, where: str) -> Any:
    """What an effect's function returned, as float arrays.

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
    if effect.place in ("mount", "part"):
        return _require_numbers(result, np.zeros((arguments[0].count, 6)), f"{where} returns")
    return _require_numbers(result, arguments[0], f"{where} returns")


def _require_numbers(result: Any, like: Array, where: str) -> Array:
    """`result` as numbers of the shape of `like`; where `like` is not finite, it need not be."""
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
    if isinstance(result, np.ndarray):
        kind = {"c": "complex numbers", "O": "objects", "b": "truth values"}.get(result.dtype.kind, "an array")
        return f"{kind} of shape {result.shape}"
    return "None" if result is None else f"a {type(result).__name__}"


def _read_only(values: Array) -> Array:
    view = values.view()
    view.flags.writeable = False
    return view


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, (bool, np.complexfloating))


def _is_positive(value: Any) -> bool:
    return _is_number(value) and bool(value > 0)

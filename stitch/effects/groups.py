"""Which parameters of an effect belong together: those of one joint, one number of a link, or all of them."""

from collections.abc import Sequence

from stitch.effects.contract import Effect, Parameter


def by_joint(effect: Effect, parameters: Sequence[Parameter]) -> list[list[int]]:
    """Indices of the parameters of each joint; empty for an effect without joints."""
    if not any(spec.kind in ("joint", "torque") for spec in effect.specs.values()):
        return []
    letters = sorted(effect.specs, key=len, reverse=True)
    joints: dict[str, list[int]] = {}
    for i, parameter in enumerate(parameters):
        letter = next(name for name in letters if parameter.name.startswith(name))
        joints.setdefault(parameter.name[len(letter) :].split("_")[0], []).append(i)
    return list(joints.values())


def without_offset(effect: Effect, parameters: Sequence[Parameter]) -> list[list[int]]:
    """Indices of all parameters but an offset; empty for an effect without one."""
    offsets = [f"{key}{axis}" for key, spec in effect.specs.items() if spec.kind == "offset" for axis in "xyz"]
    return [[i for i, p in enumerate(parameters) if p.name not in offsets]] if offsets else []


def one_by_one(effect: Effect, parameters: Sequence[Parameter]) -> list[list[int]]:
    """The smallest parts that can be true without the others."""
    if effect.place == "links" or effect.tier == "empirical":
        # One row of a table seldom is wrong altogether, nor a scanner in every term of a polynomial.
        return [[i] for i in range(len(parameters))]
    return by_joint(effect, parameters) or [*without_offset(effect, parameters), list(range(len(parameters)))]

"""Worlds of the benchmark of names: what is hidden in a cell, drawn for one trial."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from blind_cells import drawn, smallest
from blind_trials import LIBRARY
from unknown_cells import Asked, World, true_column

from data_synth import nature
from data_synth.laws.blind_first import FOREIGN, FOREIGN_IN_TIME, FOREIGN_OF_FLANGE
from data_synth.laws.blind_second import FURTHER, FURTHER_IN_TIME, FURTHER_OF_FLANGE
from data_synth.laws.blind_third import LATER, LATER_IN_TIME, LATER_OF_FLANGE
from data_synth.laws.unnamed import IN_TIME, UNNAMED
from data_synth.ordinary_arm import draw_arm, with_memory
from stitch.diagnosis.sensitivity import least_noncentrality
from stitch.effects import EFFECTS
from stitch.numerics.frames import Array

MULTIPLES = (1, 2, 3, 4, 6)
# Usual sizes of a law, 0.15 mrad or 0.05 mm rms: what errs by more is broken.
_MOST = 10.0


def nothing(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """Scatter, and effects far below what can be seen."""
    return World(_laws(a, {}, rng)), ()


def memory(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """Autoregressive pose errors, 0.9 from view to view, of 40 µm and 40 µrad."""
    return World(_laws(a, {}, rng), scatter=2 * with_memory(len(a.moments), 0.9, rng)), ("time",)


def joint_scatter(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """Every joint scatters by 15 µrad from view to view, and the flange by half of what it does elsewhere."""
    views, joints = len(a.moments), a.cell.plan.joints.shape[1]
    scatter = 0.5 * rng.standard_normal((views, 6))
    return World(_laws(a, {}, rng), joint_errors=15e-6 * rng.standard_normal((views, joints)), scatter=scatter), ()


def unnamed(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """A law outside every dictionary; couplings as often as three others."""
    law = _in_turn(["coupling", "coupling", *(n for n in UNNAMED if n != "coupling")], k)
    return _erring(a, rng, law, UNNAMED[law], of_flange=law in IN_TIME)


def by_another_hand(
    a: Asked, rng: np.random.Generator, k: int, laws: Mapping[str, Callable[..., Array]], of_flange: Sequence[str]
) -> tuple[World, tuple[str, ...]]:
    """A law of those that were written apart from all that looks for laws."""
    law = _in_turn(list(laws), k)
    return _erring(a, rng, law, laws[law], of_flange=law in of_flange)


def at_multiple(
    a: Asked, rng: np.random.Generator, k: int, make: "Part", multiple: float
) -> tuple[World, tuple[str, ...]]:
    """A law at a multiple of the size that one test for this very law would find; nothing where no arm errs so."""
    world, hidden = make(a, rng, k)
    size = multiple * _least(a, world)
    return (grown(world, size), hidden) if size <= _MOST else (World(_laws(a, {}, rng)), ())


def grown(world: World, size: float) -> World:
    """With the errors of joints and flange so many times as large."""
    return replace(
        world,
        joint_errors=size * np.asarray(world.joint_errors),
        flange_errors=size * np.asarray(world.flange_errors),
    )


def effect(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """One effect of the library at twice its smallest detectable size."""
    return _at(a, [_possible(a, rng, k)], 2.0, rng)


def beside(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """One effect at three times that size, beside an ordinary arm of half the usual size."""
    world, hidden = _at(a, [_possible(a, rng, k)], 3.0, rng)
    return replace(world, arm=draw_arm(a.cell.plan.arm.joints, 0.5, rng)), hidden


def arm(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """An ordinary arm of 0.3, 0.5 or 1 times the usual size: no joint errs above all others."""
    size = (0.3, 0.5, 1.0)[k // 12 % 3]
    return World(_laws(a, {}, rng), arm=draw_arm(a.cell.plan.arm.joints, size, rng)), ()


def two(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """Two effects at four times that size."""
    return _several(a, 2, rng, k)


def three(a: Asked, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """Three effects at four times that size."""
    return _several(a, 3, rng, k)


Part = Callable[[Asked, np.random.Generator, int], tuple[World, tuple[str, ...]]]
# The second eight were written after what the first showed was mended, the third after the second were measured.
FIRST_EIGHT = partial(by_another_hand, laws=FOREIGN, of_flange=FOREIGN_OF_FLANGE)
SECOND_EIGHT = partial(by_another_hand, laws=FURTHER, of_flange=FURTHER_OF_FLANGE)
THIRD_EIGHT = partial(by_another_hand, laws=LATER, of_flange=LATER_OF_FLANGE)
PARTS: dict[str, tuple[Part, int]] = {
    "nothing": (nothing, 100),
    "memory": (memory, 100),
    "unnamed": (unnamed, 120),
    "effect": (effect, 126),
    "beside": (beside, 42),
    "two": (two, 42),
    "three": (three, 42),
    **{f"unnamed_{n}x": (partial(at_multiple, make=unnamed, multiple=float(n)), 60) for n in MULTIPLES},
    "arm": (arm, 36),
    "foreign": (FIRST_EIGHT, 64),
    "foreign_3x": (partial(at_multiple, make=FIRST_EIGHT, multiple=3.0), 64),
    "further": (SECOND_EIGHT, 64),
    "further_3x": (partial(at_multiple, make=SECOND_EIGHT, multiple=3.0), 64),
    "later": (THIRD_EIGHT, 64),
    "later_3x": (partial(at_multiple, make=THIRD_EIGHT, multiple=3.0), 64),
    "joint_scatter": (joint_scatter, 100),
}


def _erring(
    a: Asked, rng: np.random.Generator, law: str, errors: Callable[..., Array], of_flange: bool
) -> tuple[World, tuple[str, ...]]:
    """A world with a law, and what of it may be told: the joint that follows it, or that it is of all of them."""
    time = np.array([moment.time for moment in a.moments])
    in_time = (*IN_TIME, *FOREIGN_IN_TIME, *FURTHER_IN_TIME, *LATER_IN_TIME)
    own = (time / np.median(np.diff(time)),) if law in in_time else ()
    error = errors(a.cell.plan, rng, *own)
    world = World(_laws(a, {}, rng), **{"flange_errors" if of_flange else "joint_errors": error})
    if of_flange:
        return world, (law,) if own else (law, "joints")
    return world, (law, *(f"joint {k + 1}" for k in np.flatnonzero(np.ptp(error, axis=0))))


def _laws(a: Asked, hidden: dict[str, float], rng: np.random.Generator) -> nature.Nature:
    return nature.draw(hidden, 1.0, a.cell.plan, rng)[0]


def _least(a: Asked, world: World) -> float:
    """Factor on the errors of a world at which one test for them, of as many as there are effects, finds them."""
    plain = a.linear.restricted(())
    seen = plain.residual(plain.reduce(true_column(a, world)[:, None]))
    scatter = plain.satterthwaite.degrees_of_freedom(plain.in_blocks(seen))
    return float(np.sqrt(least_noncentrality(seen, 1.0, len(EFFECTS), scatter, {1.0: 1.0})) / np.linalg.norm(seen))


def _possible(a: Asked, rng: np.random.Generator, k: int) -> str:
    """The k-th effect that this cell can have and show."""
    able = [name for name in LIBRARY if any(c.name == name for c in a.candidates)]
    return _in_turn(able, k)


def _in_turn(names: Sequence[str], k: int) -> str:
    """All names in turn, each turn one place on, so that every cell gets every name."""
    return names[(k + k // len(names)) % len(names)]


def _several(a: Asked, count: int, rng: np.random.Generator, k: int) -> tuple[World, tuple[str, ...]]:
    """So many different effects, the first of them in turn."""
    chosen = [_possible(a, rng, k)]
    while len(chosen) < count:
        further = _possible(a, rng, int(rng.integers(len(LIBRARY))))
        if further not in chosen:
            chosen.append(further)
    return _at(a, chosen, 4.0, rng)


def _at(a: Asked, laws: Sequence[str], multiple: float, rng: np.random.Generator) -> tuple[World, tuple[str, ...]]:
    chance = int(rng.integers(1 << 30))
    plain = a.linear.restricted(())
    true = drawn(a.cell.scene, a.cell.plan, a.cell.measurement, laws, chance)
    sizes = {law: smallest(plain, law, true[law]) for law in laws}
    hidden = {law: multiple * size for law, size in sizes.items() if size is not None}
    found = nature.draw(hidden, 1.0, a.cell.plan, np.random.default_rng([chance, 2]))[0]
    return World(found), tuple(hidden)

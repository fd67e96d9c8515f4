"""A session made by a simulated cell, and its truth beside it."""

from pathlib import Path

import numpy as np

from data_synth.nature import LAWS
from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from data_synth.write import write_session, write_truth
from stitch.errors import InputError
from stitch.system.process import console


def made_session(scene: str, out: Path, hide: list[str], seed: int, views: int | None, truth: Path | None) -> None:
    """Simulate a scene, write what was measured and what was true, and say how much that is.

    Raises:
        InputError, NoResultError: as `stitch synth` ends.
    """
    target = truth or truth_path(out)
    measured = make(scene, hidden_of(hide), seed, views)
    write_session(out, measured, out.name)
    write_truth(target, measured, seed)
    points = sum(len(cloud.points) for cloud in measured.clouds)
    summary = f"{len(measured.clouds)} views, {points:,} points → {out}\ntruth → {target}"
    console().print(summary, soft_wrap=True)


def make(scene: str | Path, hidden: dict[str, float], seed: int, views: int | None = None) -> Measured:
    """Simulate a scene by its name.

    Raises:
        InputError: no such scene or law, a wrong value in it; NoResultError: views that the arm cannot reach.
    """
    try:
        return simulate(load_scene(scene), hidden, seed, views)
    except ValueError as error:
        raise InputError(f"scene {scene}: {error}") from None


def hidden_of(options: list[str]) -> dict[str, float]:
    """EFFECT or EFFECT=AMPLITUDE → amplitudes; 1 is a size that a real cell could have."""
    hidden = {}
    for option in options:
        name, _, size = option.partition("=")
        if name not in LAWS:
            raise InputError(f"--hide {option}: nature knows {', '.join(LAWS)}")
        try:
            hidden[name] = float(size) if size else 1.0
        except ValueError:
            hidden[name] = np.nan
        if not np.isfinite(hidden[name]):
            raise InputError(f"--hide {option}: {size!r} is not a number")
    return hidden


def truth_path(session: Path) -> Path:
    """Where the truth of a session lies unless told otherwise."""
    return session.with_name(session.name + ".truth.json")

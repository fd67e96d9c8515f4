"""A run as far as the next question needs it: what was measured, and the model."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch.effects.user_file import load
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.capture import capture
from stitch.measurement.measurement import Measurement, Term, about_part, measurement_of
from stitch.measurement.session import Session
from stitch.model.forward import corrected
from stitch.model.model_toml import read_model
from stitch.model.terms import terms_of
from stitch.observations.surfaces.thinning import thinned
from stitch.reading.session_folder import load_session
from stitch.runs.run import Run, Step
from stitch.stages.coarse import part_size
from stitch.stages.reuse import REUSE_GATE, converged_overlaps
from stitch.system.threads import library_threads_off
from stitch.writing.target_rows import as_counted


@dataclass(frozen=True)
class State:
    """What was measured, the model, and its history."""

    session: Session
    measurement: Measurement
    terms: tuple[Term, ...]
    T_mount: Array  # (4, 4)
    T_mount_coarse: Array  # (4, 4)
    gate: float  # largest distance between partners, length_unit; NaN without clouds
    residual_rms: float
    noise_floor: float
    ledger: tuple[Step, ...]
    effects_file: str | None


def state_of(run: Run) -> State:
    """The state of a run in memory."""
    return State(
        run.session, run.measurement, run.terms, run.T_mount, run.T_mount_coarse,
        float("nan") if run.overlaps is None else run.overlaps.gate, run.residual_rms, run.noise_floor, run.ledger,
        run.effects_file,
    )  # fmt: skip


def load_state(folder: Path, effects_file: Path | None = None, thin: bool = False) -> State:
    """The state of a run folder; its session is read again, for questions about poses with thinned scans.

    Raises:
        InputError: not a run of one session, its session has gone, or an effect is not known.
    """
    document, steps = _documents(folder)
    model = read_model(folder)
    file = str(effects_file.resolve()) if effects_file else model.effects_file
    if file:
        load(Path(file))
    path = Path(document["session"])
    if not path.is_dir():
        raise InputError(f"{folder}/result.json: its session {path} has gone; put it back, or correct the path there")
    session = load_session(path)
    with library_threads_off():
        session, scans = thinned(session) if thin and session.has_clouds else (session, capture(session))
        measurement = about_part(measurement_of(session, scans), model.T_mount_coarse)
        terms = tuple(terms_of(model, measurement))
        measurement = as_counted(measurement, session, document)
        own = corrected(measurement, terms, model.T_mount)
        gate = converged_overlaps(own, model.T_mount, REUSE_GATE * part_size([own])).gate if own.scans else float("nan")
    return State(
        session, measurement, terms, model.T_mount, model.T_mount_coarse, gate, document["residual_rms"],
        document["noise_floor"], steps, file,
    )  # fmt: skip


def _documents(folder: Path) -> tuple[dict[str, Any], tuple[Step, ...]]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such run folder; `stitch run` writes one")
    if not (folder / "result.json").is_file() and (folder / "model.toml").is_file():
        inner = sorted(p.parent.name for p in folder.glob("*/result.json"))
        if inner:
            raise InputError(f"{folder}: holds the runs of several sessions ({', '.join(inner)}); name one of them")
    try:
        document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        ledger = json.loads((folder / "ledger.json").read_text(encoding="utf-8"))
        steps = tuple(
            Step(tuple(s["effects"]), s["residual_rms"], _number(s["heldout_rms"]), s["noise_floor"],
                 np.array(s["hand_eye"], float))
            for s in ledger
        )  # fmt: skip
        document["residual_rms"], document["noise_floor"], document["session"]
    except FileNotFoundError as error:
        raise InputError(f"{error.filename}: not found; name a run folder that `stitch run` wrote") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder}: result.json or ledger.json is damaged ({error}); run `stitch run` again") from None
    return document, steps


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)

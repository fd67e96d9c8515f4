"""A run as far as the next question needs it: what was measured, and the model."""

from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.measurement.capture import part_size, prepare_capture
from stitch.measurement.measurement import measurement_of, with_part_origin
from stitch.model.bound import bind_to_session
from stitch.model.forward import corrected_capture
from stitch.reading.session_folder import load_session
from stitch.runs.run import ExcludedView, ViewLinks
from stitch.runs.state import RunState
from stitch.stages.reuse import REUSE_GATE, converged_gate
from stitch.stored.run_documents import read_documents
from stitch.stored.trusted_model import trusted_model
from stitch.system.threads import library_threads_off
from stitch.writing.target_rows import restore_counted_targets


def load_state(folder: Path, effects_file: Path | None = None, trust: bool = False) -> RunState:
    """The state of a run folder; its session is read again.

    Args:
        trust: run the Python file of effects that the model names.

    Raises:
        InputError: not a run of one session, its session has gone, an effect is not known, or the model names a file
            of effects that nobody has allowed.
    """
    document, steps = read_documents(folder)
    file, effects = trusted_model(folder, effects_file, trust)
    path = Path(document["session"])
    if not path.is_dir():
        raise InputError(f"{folder}/result.json: its session {path} has gone; put it back, or correct the path there")
    session = load_session(path)
    with library_threads_off():
        measurement = with_part_origin(measurement_of(session, prepare_capture(session)), file.T_mount_coarse)
        left_out, links = left_out_of(document)
        gone = [v for v, view in enumerate(session.views) if view.name in {item.view for item in left_out}]
        session, measurement = session.without([item.view for item in left_out]), measurement.without(gone)
        model = bind_to_session(file, measurement)
        measurement = restore_counted_targets(measurement, session, document)
        own = corrected_capture(measurement, model)
        gate = converged_gate(own, model.T_mount, REUSE_GATE * part_size([own])) if own.scans else float("nan")
    return RunState(
        session=session,
        measurement=measurement,
        model=model,
        T_mount_coarse=file.T_mount_coarse,
        gate=gate,
        residual_rms=document["residual_rms"],
        noise_floor=document["noise_floor"],
        ledger=steps,
        effects_file=effects,
        left_out=left_out,
        links=links,
        doubts=tuple(document.get("doubts", ())),
        register=next((stage["method"] for stage in document["stages"] if "method" in stage), ""),
    )


def left_out_of(document: dict[str, Any]) -> tuple[tuple[ExcludedView, ...], ViewLinks]:
    """Views that the run left out, and how the others hold each other."""
    rows = {row["view"]: row for row in document["views"]}
    left_out = [
        ExcludedView(
            item["view"], item["why"], np.array(rows[item["view"]]["pose"], float), rows[item["view"]]["points"]
        )
        for item in document.get("left_out", ())
        if item["view"] in rows
    ]
    linkage = document.get("linkage", {})
    components = tuple(tuple(part) for part in linkage.get("components", ()))
    weak = tuple((row["view"], row.get("partner", "")) for row in linkage.get("weak", ()))
    return tuple(left_out), ViewLinks(components, weak)

"""Read a run folder again: its documents checked, its model, and the run that wrote it."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stitch.effects.user_file import load
from stitch.errors import InputError
from stitch.fit.correct import gate_of_model
from stitch.fit.target_fit import evaluate_targets
from stitch.model.forward import corrected_capture
from stitch.model.model import EffectsCovariance
from stitch.model.model_toml import ModelFile, bind_to_session, read_model, with_model_axes, with_model_scanners
from stitch.numerics.frames import Array
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.observations.targets.target_model import TargetModelFit
from stitch.output import result_document as results
from stitch.output.json_file import SCANS
from stitch.output.schema import read_checked
from stitch.run_data import Fit, FusedCloud, Fusion, LedgerStep, RunData, Unsupported
from stitch.screening.stock import locate_stock
from stitch.session.capture import prepare_capture
from stitch.session.kept_scans import read_scans
from stitch.session.measurement import measurement_of, with_part_origin
from stitch.session.reading.scan_files import require_room
from stitch.session.reading.session_folder import UNKNOWN, content_hash, load_session, session_hash
from stitch.session.reading.text_files import shortened
from stitch.session.scanners import join_sessions
from stitch.session.session import SessionData
from stitch.system.packages import arrow_alone, stitch_version
from stitch.system.ply_file import vertex_columns
from stitch.system.threads import library_threads_off


def read_documents(folder: Path) -> tuple[dict[str, Any], tuple[LedgerStep, ...]]:
    """Return result.json and the history of the model of a run of one session.

    Raises:
        InputError: no run folder, one of several sessions, or a damaged file.
    """
    return read_result(folder), results.LEDGER.read(read_ledger(folder))


def read_result(folder: Path) -> dict[str, Any]:
    """Return result.json of a run folder.

    Raises:
        InputError: no run folder, one of several sessions, no JSON, or an entry of another kind than stitch writes.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such run folder; to fix: name one that `stitch run` wrote")
    if not (folder / "result.json").is_file() and (folder / "model.toml").is_file():
        inner = sorted(p.parent.name for p in folder.glob("*/result.json"))
        if inner:
            raise InputError(f"{folder}: holds the runs of several sessions ({', '.join(inner)}); name one of them")
    return dict(read_checked(folder / "result.json", results.RESULT.schema))


def read_ledger(folder: Path) -> list[dict[str, Any]]:
    """Return ledger.json of a run folder, a step per change of the model.

    Raises:
        InputError: as `read_result`.
    """
    return list(read_checked(folder / "ledger.json", results.LEDGER.schema))


def trusted_model(
    path: Path, effects_file: Path | None = None, trust: bool = False, result: dict[str, Any] | None = None
) -> tuple[ModelFile, str | None]:
    """Return the model, and the absolute path of the Python file whose effects were loaded for it; None: no file.

    Args:
        path: run folder, or model.toml.
        effects_file: the user's own file; takes the place of the one that the model names.
        trust: run the file that the model names.
        result: result.json beside it, if it has been read.

    Raises:
        InputError: no model, a value in it that is no number, or a file of effects that nobody has allowed.
    """
    model = replace(read_model(path), effects_covariance=_stored_covariance(path, result))
    file = path / "model.toml" if path.is_dir() else path
    for effect, parameters in model.effects.items():
        for name, parameter in parameters.items():
            if not np.isfinite(parameter.value):
                raise InputError(f"{file}: effects.{effect}.{name} is {parameter.value}; to fix: write a finite number")
    if effects_file is not None:
        load(effects_file)
        return model, str(effects_file.resolve())
    if model.effects_file and not trust:
        raise InputError(
            f"{file}: names effects in {model.effects_file}, Python that runs with your rights; to fix: read it, "
            "then allow it with --trust, or name a file of your own with --effects-file"
        )
    if model.effects_file:
        stated = (file.parent / model.effects_file).resolve()
        load(stated)
        return model, str(stated)
    return model, None


def _stored_covariance(path: Path, result: dict[str, Any] | None) -> EffectsCovariance:
    """Return the covariance of the effects' parameters from the result.json beside a model.toml.

    The folder of several sessions has a result.json in each inner folder: the first one is taken, since they share
    their effects. Without a file the covariance is empty.
    """
    folder = path if path.is_dir() else path.parent
    files = [folder / "result.json", *sorted(folder.glob("*/result.json"))]
    file = next((file for file in files if file.is_file()), None)
    return EffectsCovariance() if file is None else results.effects_covariance(result or read_result(file.parent), file)


def load_run(folder: Path, effects_file: Path | None = None, trust: bool = False) -> RunData:
    """Return the run that wrote a folder; its session is read again and nothing is fitted.

    Args:
        trust: run the Python file of effects that the model names.

    Raises:
        InputError: not a run of one session, its session has gone, an effect is not known, or the model names a file
            of effects that nobody has allowed.
    """
    document, steps = read_documents(folder)
    file, effects = trusted_model(folder, effects_file, trust, document)
    whole_session = _session_of_run(folder, document, file)
    left_out = results.excluded_views(document)
    session = whole_session.without([item.view for item in left_out])
    # The order is that of a run: views, model, points that count, stock. Each needs those before it.
    with library_threads_off():
        capture = prepare_capture(whole_session, read_scans(folder / SCANS))
        whole = with_part_origin(measurement_of(whole_session, capture), file.T_mount_coarse)
        measurement = whole.without([v for v, name in enumerate(whole_session.names) if name not in session.names])
        model = bind_to_session(file, measurement)
        measurement = results.restore_counted_targets(measurement, session, document)
        fields = results.RESULT.fields(document, RunData)
        if "gate" not in fields:
            # Earlier versions did not write it.
            fields["gate"] = gate_of_model(corrected_capture(measurement, model), model.T_mount)
        if stock := results.stock_of_views(document, session.names):
            # The result states thickness and sigma of the stock; its points are found again.
            capture = corrected_capture(measurement, model)
            stock = locate_stock(session, capture, model.T_mount, fields["gate"], stock)
            measurement = replace(measurement, capture=measurement.capture.without_stock(stock))
    return RunData(
        session=session,
        measurement=measurement,
        model=model,
        T_mount_coarse=file.T_mount_coarse,
        source=partial(_read_fit, folder),
        ledger=steps,
        effects_file=effects,
        left_out=left_out,
        tried={row["effect"]: row["dropped"] for row in _whole_diagnosis(folder).get("tried", ())},
        register_method=results.register_method(document),
        alone=results.scanners_alone(document),
        **fields,
    )


def _session_of_run(folder: Path, document: dict[str, Any], file: ModelFile) -> SessionData:
    """Return the session that a run is of, read again, all of its views; of several scanners their sessions joined.

    Args:
        folder: of the run, for messages.
        document: result.json.
        file: the run's model, which says where axes and scanners stood before the fit.

    Raises:
        InputError: a session's folder has gone or cannot be read, or session and model have other axes or scanners.
    """
    paths = [Path(path) for path in document.get("sessions", [document["session"]])]
    gone = next((path for path in paths if not path.is_dir()), None)
    if gone is not None:
        raise InputError(f"{folder}/result.json: its session {gone} has gone; to fix: restore it or correct the path")
    sessions = [with_model_axes(load_session(path), file) for path in paths]
    return join_sessions(with_model_scanners(sessions, file)) if len(sessions) > 1 else sessions[0]


def read_diagnosis(folder: Path) -> dict[str, Any]:
    """Return diagnosis.json of a run folder, its verdict and candidates checked; {} where there is none.

    Raises:
        InputError: a damaged diagnosis.json.
    """
    file = folder / "diagnosis.json"
    if not file.is_file():
        return {}
    from stitch.output.diagnosis_document import DIAGNOSIS

    return dict(read_checked(file, DIAGNOSIS.schema))


def standing_diagnosis(folder: Path, run: RunData) -> dict[str, Any]:
    """Return diagnosis.json of a run folder if it is of this very run; else {}.

    It is outdated when session, model, effects' file or the version of stitch changed since.
    """
    document = _whole_diagnosis(folder)
    state = diagnosed_state(run, folder) if document else UNKNOWN
    return document if UNKNOWN not in state and document.get("of") == state else {}


def _whole_diagnosis(folder: Path) -> dict[str, Any]:
    """Return diagnosis.json of a run folder; {} where there is none, or a damaged one, which a diagnosis replaces."""
    try:
        return read_diagnosis(folder)
    except InputError:
        return {}


def diagnosed_state(run: RunData, folder: Path) -> str:
    """Return an identification of what is diagnosed, to compare with the entry `of` of diagnosis.json.

    It consists of stitch's version and hashes of the session, the run's model and result, and the effects' file.
    """
    result = content_hash(folder, [folder / "model.toml", folder / "result.json"])
    file = None if run.effects_file is None else Path(run.effects_file)
    effects = "" if file is None else content_hash(file.parent, [file])
    return " ".join((stitch_version(), session_hash(run.session), result, effects)).strip()


def fused_cloud(path: Path) -> FusedCloud:
    """Return what stitched.ply holds; reference frame, length_unit.

    Raises:
        InputError: not there, as in a run of which the numbers alone are kept; not readable, or too large.
    """
    if not path.exists():
        cell = path.parent.parent
        if (cell / "result.json").is_file():
            raise InputError(f"{path.parent}: one scanner of {cell}, which has the cloud of all; to fix: name {cell}")
        raise InputError(f"{path}: not kept; to fix: stitch run SESSION -o {path.parent} --force makes it again")
    require_room(path)
    vertex = vertex_columns(path)
    columns = np.column_stack([vertex[name] for name in ("x", "y", "z", "nx", "ny", "nz", "residual")])
    columns = columns.astype(np.float64)
    # Earlier versions called it count.
    views = vertex["views" if "views" in vertex else "count"]
    return FusedCloud(columns[:, :3], columns[:, 3:6], columns[:, 6], np.asarray(views))


def _read_fit(folder: Path, run: RunData) -> Fit:
    """Return the results of a stored run's stages; correspondences are searched again, nothing is fitted.

    Raises:
        InputError: a file of the folder is damaged, or belongs to another model or session.
    """
    model = read_model(folder)
    try:
        document = read_result(folder)
        _require_same(folder, document, model, run)
        return _restore_fit(folder, document, run)
    except (LookupError, TypeError, ValueError, OSError) as error:
        reason = shortened(" ".join(str(error).split()))
        raise InputError(f"{folder}: its files are damaged ({reason}); to fix: run `stitch run` again") from None


def _require_same(folder: Path, document: dict[str, Any], model: ModelFile, run: RunData) -> None:
    """Refuse a run whose model.toml or views.csv was changed after result.json was written.

    Raises:
        InputError: says which of the two, and what to do.
    """
    if not results.has_model(document, model):
        raise InputError(
            f"{folder}/model.toml: changed after the run; see what it does with `stitch run {run.session.path} "
            f"--hand-eye {folder} -o ANOTHER`"
        )
    if [row.view for row in _fused_views(document, run)] != run.session.names:
        raise InputError(f"{run.session.path}/views.csv: changed after {folder}; to fix: run `stitch run` again")


def _fused_views(document: dict[str, Any], run: RunData) -> list[results.ViewRow]:
    """Return the rows of result.json of the views that the run has not left out."""
    excluded = {item.view for item in run.left_out}
    return [row for row in results.view_rows(document) if row.view not in excluded]


def _restore_fit(folder: Path, document: dict[str, Any], run: RunData) -> Fit:
    """Return the fit of a stored run, with its correspondences searched again at its final poses.

    Args:
        document: result.json.
        run: the run so far, with session and model.
    """
    views = _fused_views(document, run)
    poses = np.array([row.pose for row in views])
    registered = targets = None
    with library_threads_off():
        capture = corrected_capture(run.measurement, run.model)
        if capture.scans:
            # Of register, where the result states it.
            gate = (document.get("disagreement") or {}).get("gate") or run.gate
            registered = collect_overlaps(capture, poses, gate)
        if document.get("targets") and capture.sightings is not None:
            targets = _target_fit(folder, run)
    stated = results.RESULT.fields(document, Fit)
    stages = {stage.name: stage for stage in stated.pop("stages")}
    unsupported = stated.pop("unsupported", Unsupported())
    fused = Fusion(fused_cloud(folder / "stitched.ply"), unsupported, stages.pop("fuse", None))
    return Fit(
        stages_before=tuple(stages.values()),
        poses_model=capture.poses(run.model.T_mount),
        poses=poses,
        corrections=np.array([row.correction for row in views]),
        view_rms=np.array([row.rms for row in views]),
        fusion_source=fused,
        registered=registered,
        targets=targets,
        **stated,
    )


def _target_fit(folder: Path, run: RunData) -> TargetModelFit:
    """Return the labelled points evaluated under the model.

    Distances on views left out would need fits: they are read from residuals.parquet.
    """
    from pyarrow.parquet import read_table

    fit = evaluate_targets(run.measurement, run.model)
    used = fit.rows.sightings.used
    heldout: Array = np.full(used.shape, np.nan)
    # Beside clouds views are left out with their surfaces, not by their labelled points.
    if not run.measurement.capture.scans:
        arrow_alone()
        heldout[used] = read_table(folder / "residuals.parquet")["heldout"].to_numpy()
    return replace(fit, heldout=heldout)

"""`stitch.export_run`: what `stitch export RUN --to` does, of a run in memory."""

from pathlib import Path

from stitch.api.run import Run
from stitch.api.verbs import stored_cloud
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.errors import InputError, did_you_mean
from stitch.output.diagnosis_document import diagnosis_document
from stitch.output.result_document import model_of, result_document, scanner_documents
from stitch.plugins.export.cloud_formats import CLOUD_FORMATS, coloured, in_datum
from stitch.plugins.export.formats import Arm, Cloud, HandEye
from stitch.plugins.export.hand_eye_formats import HAND_EYE_FORMATS, hand_eye_from, session_of_scanner
from stitch.plugins.metrology.budget import MeasuredFeatures
from stitch.plugins.metrology.calibrate.arm_model import ARM_FORMATS, arm_from
from stitch.run_data import RunData
from stitch.system.files import whole_file


def export_run(
    run: RunData,
    to: HandEye | Arm | Cloud,
    file: Path | str | None = None,
    *,
    parent: str | None = None,
    child: str | None = None,
    scanner: str | None = None,
    with_effects: bool = False,
    diagnosis: Diagnosis | None = None,
    datum: MeasuredFeatures | None = None,
) -> str | None:
    """Write what a run found for other programs, as `stitch export RUN --to` does.

    Args:
        to: ros, urdf, opencv, zivid, kuka, fanuc, abb or ur for the hand-eye; arm-dh or arm-urdf; ply, pcd, las, laz,
            e57 or glb for the stitched cloud.
        file: is written, whole or not at all; a cloud needs one.
        parent, child: names of the frames that carry the scanner and are the scanner's own.
        scanner: name of one of several, whose hand-eye it is.
        with_effects: the hand-eye that goes with the model's effects, not that at their mean over the views.
        diagnosis: of the run; what is written says what it found.
        datum: features that `stitch.measure` found in the frame of a datum, in which a cloud is then written.

    Returns:
        The text, of T_parent_child (4, 4) in the unit that it states, U beside it; None of a cloud, which is written in
        the reference frame, or in that of the datum.

    Raises:
        InputError: a format that is not known, no file for a cloud, a run that has no such thing, several scanners of
            which none is named, or features without a datum.

    Example:
        >>> "T_flange_scanner" in stitch.export_run(run, "ros")
        True
        >>> stitch.export_run(run, "ply", folder / "cloud.ply")
    """
    path = None if file is None else Path(file)
    if datum is not None and to not in CLOUD_FORMATS:
        raise InputError(f"datum: is of a cloud; to fix: name one of {', '.join(CLOUD_FORMATS)}")
    if to in CLOUD_FORMATS:
        _write_cloud(run, to, path, datum)
        return None
    if to in ARM_FORMATS:
        session = run.measured if isinstance(run, Run) and run.measured is not None else run.session
        text = ARM_FORMATS[to](arm_from(session, model_of(run)))
    elif to in HAND_EYE_FORMATS:
        document = {} if diagnosis is None else diagnosis_document(diagnosis)
        result, model = result_document(run), model_of(run)
        if own := session_of_scanner(result, scanner):
            result, model = scanner_documents(run, result)[own]
        eye = hand_eye_from(result, model, document, parent, child or scanner, with_effects)
        text = HAND_EYE_FORMATS[to](eye)
    else:
        formats = (*HAND_EYE_FORMATS, *ARM_FORMATS, *CLOUD_FORMATS)
        raise InputError(f"{to}: no such format{did_you_mean(to, formats)}; to fix: one of {', '.join(formats)}")
    if path is not None:
        with whole_file(path) as out:
            out.write_text(text, encoding="utf-8")
    return text


def _write_cloud(run: RunData, to: str, path: Path | None, datum: MeasuredFeatures | None) -> None:
    if path is None or path.suffix.lower() != f".{to}":
        raise InputError(f"{to}: where to? to fix: name the file NAME.{to}")
    if not len(run.fused.points):
        raise InputError(f"{run.session.name}: labelled points alone give no cloud; there is none to export")
    write, _ = CLOUD_FORMATS[to]
    cloud = coloured(stored_cloud(run), run.session.length_unit)
    if datum is not None:
        if datum.T_datum_reference is None:
            raise InputError("datum: these were measured without one; to fix: state datum in FEATURES.toml")
        cloud = in_datum(cloud, datum.T_datum_reference)
    with whole_file(path) as out:
        write(cloud, out)

"""result.json, ledger.json and the model of a run, as plain data, and what is read of them again."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stitch.effects.axis_effects import SCANNER_PLACEMENT
from stitch.effects.contract import Effect, Parameter
from stitch.effects.user_source import EFFECTS_FILE, source_of
from stitch.errors import InputError
from stitch.fusion.register import method_named, pose_covariance
from stitch.model.hand_eye_alone import HandEyeAlone, hand_eye_alone
from stitch.model.model import EffectsCovariance, Target
from stitch.model.model_toml import ModelFile
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.scanner_places import ScannerAlone, ScannerPlace
from stitch.observations.surfaces.hand_eye_fit import Repeatability, capture_repeatability
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.observations.targets.outliers import Outlier, mask_outliers
from stitch.observations.targets.target_model import TargetModelFit
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.output.json_file import FORMAT
from stitch.output.schema import (
    COUNT,
    MATRIX,
    NUMBER,
    NUMBER_OR_NULL,
    TEXT,
    TEXTS,
    Document,
    Key,
    Kind,
    array_of,
    list_of,
    number,
    table_of,
)
from stitch.run_data import ExcludedView, Fit, LedgerStep, Note, RunData, StageResult, Unsupported, ViewLinks
from stitch.session.measurement import Measurement
from stitch.session.scan import Stock
from stitch.session.session import Scanner, SessionData, View
from stitch.system.packages import stitch_version
from stitch.system.values import plain

_PACKAGES = ("numpy", "scipy", "pykdtree", "libigl", "rerun-sdk", "kiss-icp", "trimesh")


class ViewRow(NamedTuple):
    """A view as result.json lists it."""

    view: str
    pose: Array  # (4, 4) T_reference_scanner; of a view that is not fused as robot and model say
    correction: Array  # (6,) twist in the reference frame, rad and length_unit
    rms: float | None  # length_unit; null without partners, and of a view that is not fused
    points: int = 0


class StockRow(NamedTuple):
    """Stock as result.json lists it: taken off a view's scan, where it stood off from the others."""

    view: str
    thickness: float  # length_unit, outwards
    sigma: float
    share: float  # of the scan's surface
    # (6,) of its pose, once the stock is off, beside the mean of the other views: by which it turns, rad, and by which
    # the middle of its points moves, length_unit, reference frame.
    pose_sigma: Array | None = None


def result_document(run: RunData) -> dict[str, Any]:
    """Return result.json as a dictionary."""
    return RESULT.write(run)


def ledger(run: RunData) -> list[dict[str, Any]]:
    """Return the model's history, one step per change."""
    return [{"step": i} | _LEDGER_STEP.write(step) for i, step in enumerate(run.ledger)]


def model_of(run: RunData) -> ModelFile:
    """Return the model of a run as model.toml states it.

    It names a Python file of effects only while an effect of a user is in it.
    """
    return ModelFile(
        length_unit=run.session.length_unit,
        mount=run.session.mount,
        T_mount=run.T_mount,
        T_mount_coarse=run.T_mount_coarse,
        covariance=run.mount_covariance,
        effects={term.name: {p.name: p for p in term.parameters} for term in run.terms},
        effects_file=recorded_effects_file(run),
        targets=_targets(run.targets),
        effects_covariance=run.model.effects_covariance,
        axes={a.name: (a.direction, a.point) for a in run.session.axes if a.direction is not None},
        scanners={p.scanner.name: p.scanner.T_mount for p in run.session.parts if p.scanner.T_mount is not None},
    )


def recorded_effects_file(run: RunData) -> str | None:
    """Return the path of the user's effects that model.toml names: their one Python file, or else `EFFECTS_FILE`.

    None without such effects. `EFFECTS_FILE` lies in the run folder itself; `effects_source` is its text.
    """
    origins = {effect.origin or run.effects_file or EFFECTS_FILE for effect in own_effects(run)}
    if not origins:
        return None
    file = origins.pop()
    # Several files become one. A file that is called EFFECTS_FILE lies in the folder of another run, which may go.
    return EFFECTS_FILE if origins or Path(file).name == EFFECTS_FILE else file


def own_effects(run: RunData) -> list[Effect]:
    """Return effects in use that neither stitch nor an installed package has."""
    own = [term.effect for term in run.terms if term.effect.tier == "user"]
    return [effect for effect in own if not effect.origin.startswith("package")]


def effects_source(run: RunData) -> str | None:
    """Return the text of `EFFECTS_FILE`, the file of the user's effects in the run folder; None where none is needed.

    Raises:
        InputError: the source of an effect is not at hand, or would not run on its own.
    """
    own = own_effects(run)
    if recorded_effects_file(run) != EFFECTS_FILE:
        return None
    before = Path(own[0].origin or run.effects_file or "")
    return before.read_text(encoding="utf-8") if before.name == EFFECTS_FILE else source_of(own)


def _hand_eye_alone(run: RunData) -> HandEyeAlone | None:
    return hand_eye_alone(run.measurement, run.model)


def residual_columns(fit: TargetModelFit, session: SessionData) -> dict[str, Array]:
    """Return columns of residuals.parquet of labelled points, a row per target and view in which it is used.

    `partner` is the target; x, y, z its fitted position in the reference frame. `residual` is the 3D distance of the
    measured point from it (length_unit), (nx, ny, nz) its direction. Covariates and `time_s` are NaN where unknown.
    """
    rows = fit.rows
    sightings = rows.sightings
    v, slot = np.nonzero(sightings.used)
    target = sightings.target[v, slot]
    # Rows of views come first; each begins with the residuals of positions, three numbers a slot.
    offset = rows.residual[: len(sightings.used), : rows.positions].reshape(*sightings.used.shape, 3)[v, slot]
    distance = np.linalg.norm(offset, axis=1)
    covariates = sorted({key for view in session.views for key in view.covariates})
    return {
        "view": np.array(session.names)[v],
        "partner": np.array(sightings.targets)[target],
        **dict(zip("xyz", fit.landmarks.positions[target].T, strict=True)),
        **dict(zip(("nx", "ny", "nz"), (offset / np.maximum(distance, 1e-300)[:, None]).T, strict=True)),
        "residual": distance,
        "heldout": fit.heldout[v, slot],
        **{key: np.array([view.covariates.get(key, np.nan) for view in session.views])[v] for key in covariates},
        "time_s": np.array([view.time_s for view in session.views], float)[v],
    }


def points_of(view: View) -> int:
    """Return the number of points that a view shows, of its cloud and by name."""
    labelled = 0 if view.sighting is None else len(view.sighting.targets)
    return labelled + (0 if view.cloud is None else view.cloud.count)


def parameter_row(parameter: Parameter) -> dict[str, Any]:
    """Return a parameter of an effect as the documents list it."""
    row = {"value": parameter.value, "sigma": parameter.sigma, "unit": parameter.unit}
    return row | ({"view": parameter.view} if parameter.view else {})


def excluded_views(document: dict[str, Any]) -> tuple[ExcludedView, ...]:
    """Return the views that a run left out, with reason and pose, from its result.json."""
    rows = {row.view: row for row in view_rows(document)}
    return tuple(
        ExcludedView(item["view"], item["why"], rows[item["view"]].pose, rows[item["view"]].points)
        for item in document.get("left_out", ())
        if item["view"] in rows
    )


def view_rows(document: dict[str, Any]) -> tuple[ViewRow, ...]:
    """Return all views of a result in their order."""
    return _VIEWS.read(document["views"])


def has_model(document: dict[str, Any], model: ModelFile) -> bool:
    """Return True if a result.json has exactly the hand-eye and the parameters of a model.toml."""
    stated = {effect: {p: row["value"] for p, row in rows.items()} for effect, rows in document["effects"].items()}
    values = {effect: {p: fitted.value for p, fitted in rows.items()} for effect, rows in model.effects.items()}
    return stated == values and np.array_equal(document["hand_eye"], model.T_mount)


def register_method(document: dict[str, Any]) -> str:
    """Return by which method a run registered single views; empty without clouds."""
    return next((stage["method"] for stage in document["stages"] if "method" in stage), "")


def effects_covariance(document: dict[str, Any], file: Path) -> EffectsCovariance:
    """Return the covariance of the effects' parameters that a result.json states; an empty one where it states none.

    Args:
        document: result.json.
        file: its path, for messages.

    Raises:
        InputError: a matrix of another size than its names, or without positive variances.
    """
    if not (stated := document.get("effects_covariance")):
        return EffectsCovariance()
    known = _COVARIANCE.fields(stated)
    names, rows = known["names"], known["matrix"]
    if [len(row) for row in rows] != [len(names)] * len(names):
        raise InputError(
            f"{file}: effects_covariance.matrix is not {len(names)}x{len(names)} for its {len(names)} parameters; "
            "to fix: run `stitch run` again, or take the entry out"
        )
    matrix = np.array(rows, float).reshape(len(names), len(names))
    if not np.isfinite(matrix).all() or (np.diag(matrix) <= 0).any():
        raise InputError(f"{file}: effects_covariance holds no variances; to fix: run `stitch run` again")
    with_hand_eye = np.array(known.get("with_hand_eye", []), float)
    return EffectsCovariance(names, matrix, with_hand_eye.reshape(6, -1))


def restore_counted_targets(measurement: Measurement, session: SessionData, document: dict[str, Any]) -> Measurement:
    """Return the measurement with labelled points as the stored fit used them; without such points, as it is.

    The outliers that result.json lists are not used, and points weigh against clouds by its `cloud_noise_factor`.
    """
    capture = measurement.capture
    sightings = capture.sightings
    if sightings is None:
        return measurement
    place = {view.name: v for v, view in enumerate(session.views)}
    outliers = [
        Outlier(place[row["view"]], row["target"], np.nan, np.nan)
        for row in document.get("outliers", ())
        if row["view"] in place
    ]
    used = mask_outliers(sightings.used, outliers, sightings.targets, sightings.target)
    factor = document.get("cloud_noise_factor", capture.noise_factor)
    counted = replace(capture, sightings=replace(sightings, used=used), noise_factor=factor)
    return replace(measurement, capture=counted)


def _targets(fit: TargetModelFit | None) -> dict[str, Target]:
    """Return the targets that were located, by name: position (3,), sigma and orientation in the reference frame."""
    if fit is None:
        return {}
    places = fit.landmarks.positions
    return {
        name: Target(places[k], fit.landmark_sigmas[k], fit.landmarks.orientation)
        for k, name in enumerate(fit.rows.sightings.targets)
        if np.isfinite(places[k]).all()
    }


def _target_rows(run: RunData) -> list[dict[str, Any]]:
    """Return rows of result.json of the targets: position in the reference frame, sigma, number of views."""
    if run.targets is None:
        return []
    sightings = run.targets.rows.sightings
    seen = dict(zip(sightings.targets, sightings.view_counts, strict=True))
    return [
        {"target": name, "position": t.position.tolist(), "sigma": t.sigma.tolist(), "seen": int(seen[name])}
        | ({} if t.orientation is None else {"orientation": t.orientation.tolist()})
        for name, t in _targets(run.targets).items()
    ]


def _sizes(distances: Array) -> dict[str, float]:
    """Return mean, median and largest of distances, length_unit, without those that are NaN."""
    known = distances[np.isfinite(distances)]
    return {"mean": float(known.mean()), "median": float(np.median(known)), "max": float(known.max())}


def _outlier_rows(run: RunData) -> list[dict[str, Any]]:
    """Return rows of the labelled points that were not used: view, target, distance, and its ratio to the usual one."""
    return [
        {"view": run.session.views[o.view].name, "target": o.target, "distance": o.distance, "times_usual": o.times}
        for o in run.outliers
    ]


def _has_labelled_alone(run: RunData) -> bool:
    """Return whether the rms of the run is that of labelled points; beside clouds it is that of the surfaces."""
    return run.targets is not None and not run.session.has_clouds


def _all_views(run: RunData) -> list[ViewRow]:
    """Return rows of all views in the order of the session, fused ones and those that were left out.

    A fused view knows its number in the session; the views left out fill the numbers between, in their own order.
    """
    rows = {
        int(place): ViewRow(view.name, run.poses[v], run.corrections[v], float(run.view_rms[v]), points_of(view))
        for v, (view, place) in enumerate(zip(run.session.views, run.measurement.views.number, strict=True))
    }
    free = [place for place in range(len(rows) + len(run.left_out)) if place not in rows]
    for place, item in zip(free, run.left_out, strict=True):
        rows[place] = ViewRow(item.view, item.pose, np.zeros(6), None, item.points)
    return [rows[place] for place in sorted(rows)]


def _stock_rows(run: RunData) -> list[StockRow]:
    """Return a row for each scan with stock, material still on the part there: its thickness, and the pose's sigma."""
    scans = zip(run.session.names, run.measurement.capture.scans, strict=False)
    found = [(name, scan.stock) for name, scan in scans if scan.stock is not None]
    return [StockRow(name, s.thickness, s.sigma, s.share, _pose_sigma(run, name)) for name, s in found]


def _pose_sigma(run: RunData, name: str) -> Array:
    """Return sigmas (6,) of a view's pose relative to the mean of the other views, reference frame.

    Rotation first, rad, then the motion of the middle of the view's points, length_unit. With A the difference of this
    view's twist and the mean of the others', they are the roots of the diagonal of A C Aᵀ, C the poses' covariance.
    """
    assert run.registered is not None
    capture, count, view = run.measurement.capture, len(run.poses), run.session.names.index(name)
    scatter = run.repeatability
    if not np.isfinite(scatter.noise_factor):
        # A run that was read from its folder does not know the noise factor: it is found again.
        unconstrained = unconstrained_poses(capture, run.poses_model, run.gate)
        scatter = capture_repeatability(capture, unconstrained, run.T_mount)
    method = method_named(run.register_method)
    covariance = pose_covariance(run.registered, capture, run.poses, run.T_mount, scatter, method)
    middle = frames.transform(run.poses[view], capture.scans[view].points.mean(axis=0)[None])[0]
    weights = np.where(np.arange(count) == view, 1.0, -1 / (count - 1))
    A = np.kron(weights, frames.adjoint(frames.make(np.eye(3), run.registered.gram.centre - middle)))
    return np.sqrt(np.diag(A @ covariance @ A.T))


def stock_of_views(document: dict[str, Any], names: Sequence[str]) -> dict[int, Stock]:
    """Return the stock that a result.json states, by the index of its view in `names`.

    Which points belong to it is not stored: the mask is empty, and `locate_stock` finds them again.
    """
    rows = [StockRow(**row) for row in document.get("stock", ())]
    nowhere = np.zeros(0, bool)
    return {names.index(r.view): Stock(r.thickness, r.sigma, r.share, nowhere) for r in rows if r.view in names}


def _scanner_rows(run: RunData) -> list[dict[str, Any]]:
    """Return rows of the scanners of a joined session: its hand-eye, and that from its own views alone."""
    parts = {part.scanner.name: part for part in run.session.parts}
    return [
        {"scanner": place.name, "session": parts[place.name].name} | _SCANNER.write(place) for place in run.scanners
    ]


def scanner_documents(run: RunData, whole: dict[str, Any]) -> dict[str, tuple[dict[str, Any], ModelFile]]:
    """Return result.json and model of each single scanner of a joined run, by the name of its session.

    Another run can so use the model of one scanner. It has that scanner's hand-eye, the effects of this scanner or of
    all, and its views. Entries that hold only for all scanners together, such as the effects' covariance, are left out.
    Names EFFECT@SCANNER and VIEW@SCANNER lose their ending.

    Args:
        whole: result.json of the joined run.
    """
    common = model_of(run)
    documents = {}
    for part, place, row in zip(run.session.parts, run.scanners, whole["scanners"], strict=True):
        name = part.scanner.name
        model = _model_of_scanner(common, part.scanner, place)
        own_entries = {
            "session": str(part.path.resolve()),
            "name": part.name,
            "hand_eye_coarse": plain(model.T_mount_coarse),
            "effects": {e: {p: parameter_row(x) for p, x in table.items()} for e, table in model.effects.items()},
            "hand_eye_stated": False,
            **{key: value for key, value in row.items() if key not in ("session", "alone", "U")},
            "views": _own_rows(whole["views"], name),
            "left_out": _own_rows(whole["left_out"], name),
            "linkage": {},
            "stock": _own_rows(whole.get("stock", []), name),
        }
        of_all = ("sessions", "scanners", "effects_covariance", "hand_eye_sigma_anywhere")
        documents[part.name] = ({k: v for k, v in whole.items() if k not in of_all} | own_entries, model)
    return documents


def _model_of_scanner(common: ModelFile, scanner: Scanner, place: ScannerPlace) -> ModelFile:
    """Return the model of one scanner of a joined run: its hand-eye `place`, and the effects of it or of all.

    Args:
        common: model of the joined run.
        scanner: as its own session states it.
    """
    effects = {
        effect.removesuffix(f"@{scanner.name}"): parameters
        for effect, parameters in common.effects.items()
        if effect != SCANNER_PLACEMENT and effect.partition("@")[2] in ("", scanner.name)
    }
    return replace(
        common,
        T_mount=place.T_mount,
        T_mount_coarse=place.T_mount if scanner.T_mount is None else scanner.T_mount,
        covariance=place.covariance,
        effects=effects,
        effects_covariance=EffectsCovariance(),
        scanners={},
    )


def _own_rows(rows: list[dict[str, Any]], scanner: str) -> list[dict[str, Any]]:
    """Return the rows of views VIEW@SCANNER of one scanner, their `view` without the ending."""
    own = [row for row in rows if row["view"].endswith(f"@{scanner}")]
    return [row | {"view": row["view"].removesuffix(f"@{scanner}")} for row in own]


def scanners_alone(document: dict[str, Any]) -> tuple[ScannerAlone, ...]:
    """Return the hand-eye of each scanner from its own views alone, of a result.json; empty for one scanner."""
    rows = [(row["scanner"], row["alone"]) for row in document.get("scanners", ()) if "alone" in row]
    return tuple(
        ScannerAlone(name, np.array(own["hand_eye"], float), np.array(own["hand_eye_covariance"], float))
        for name, own in rows
    )


def _disagreement(run: RunData) -> dict[str, Any] | None:
    """Return how far the views disagree on the part, length_unit, for every step of the model's history.

    Of each step the mean distance over the part (`mean`), what of it noise alone would make (`of_noise`), and the
    distance that nearly all of the part stays below (`largest`). None without clouds.
    """
    history = model_history(run)
    if history is None or run.registered is None:
        return None
    return {
        "gate": run.registered.gate,
        "patch_radius": history.patches.radius,
        "steps": [
            {"step": s.name, "mean": s.field.mean_abs, "of_noise": s.field.noise, "largest": s.field.quantile()}
            for s in history.steps
        ],
    }


def _versions() -> dict[str, str]:
    """Return the version of stitch, and of each package that decides its numbers and is installed."""
    versions = {"stitch": stitch_version()}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


_NOTE = Document(Key("at", TEXT), Key("by", TEXT), Key("text", TEXT))
_LEDGER_STEP = Document(
    Key("effects", TEXTS),
    Key("parameters", table_of(table_of(NUMBER)), "values", optional=True),
    Key("hand_eye", MATRIX, "T_mount"),
    Key("residual_rms", NUMBER),
    Key("heldout_rms", NUMBER_OR_NULL),
    Key("noise_floor", NUMBER),
    Key("notes", _NOTE.rows(Note), when=attrgetter("notes")),
    Key("predicted_heldout_rms", NUMBER, "predicted", when=lambda step: np.isfinite(step.predicted)),
)
LEDGER = _LEDGER_STEP.rows(LedgerStep)
_STAGE = Document(
    Key("name", TEXT),
    Key("rms", NUMBER_OR_NULL),
    Key("correspondences", COUNT),
    Key("iterations", COUNT),
    Key("seconds", NUMBER, write=lambda stage: round(stage.seconds, 3)),
    Key("note", TEXT, optional=True),
    Key("method", TEXT, when=attrgetter("method")),
)
_VIEW = Document(
    Key("view", TEXT),
    Key("pose", MATRIX),
    Key("correction", array_of(6)),
    Key("rms", NUMBER_OR_NULL),
    Key("points", COUNT, optional=True),
)
_VIEWS = _VIEW.rows(ViewRow)
_PARAMETER = Kind({"type": "object", "properties": {"value": NUMBER.schema}, "required": ["value"]})
_EFFECTS = Kind(
    table_of(table_of(_PARAMETER)).schema,
    lambda terms: {term.name: {p.name: parameter_row(p) for p in term.parameters} for term in terms},
)
_ALONE = Document(
    Key("hand_eye", MATRIX, "T_mount"),
    Key("covariance", Kind(list_of(list_of(NUMBER)).schema)),
    Key("displacement", NUMBER),
    Key("spread", NUMBER),
)
_SCANNER_ALONE = Document(
    Key("hand_eye", attribute="alone.hand_eye"),
    Key("hand_eye_covariance", attribute="alone.covariance"),
    Key("U", attribute="U_alone"),
    Key("apart"),
)
_SCANNER = Document(
    Key("hand_eye", attribute="T_mount"),
    Key("hand_eye_sigma", attribute="sigma"),
    Key("hand_eye_covariance", attribute="covariance"),
    Key("unobservable"),
    Key("hand_eye_unknown", attribute="unknown"),
    Key("U"),
    Key("alone", write=_SCANNER_ALONE.write, when=attrgetter("alone")),
)
_SCATTER = Document(Key("rotation", NUMBER_OR_NULL), Key("translation", NUMBER_OR_NULL))
_STOCK = Document(
    Key("view", TEXT),
    *(Key(name, NUMBER) for name in ("thickness", "sigma", "share")),
    Key("pose_sigma", array_of(6), optional=True),
)
_LEFT_OUT = Document(Key("view", TEXT), Key("why", TEXT))
_WEAK = Document(
    Key("view", TEXT, write=itemgetter(0)),
    Key("partner", TEXT, write=itemgetter(1), optional=True),
    Key("directions", write=lambda _: "all, through one pair"),
)
_LINKAGE = Document(
    Key("components", list_of(TEXTS), optional=True),
    Key("weak", _WEAK.rows(lambda view, partner="": (view, partner)), optional=True),
)
_UNSUPPORTED = Document(*(Key(name, COUNT, optional=True) for name in ("points", "alone", "looked_through")))
_COVARIANCE = Document(
    Key("parameters", TEXTS, "names"),
    Key("matrix", Kind(list_of(list_of(NUMBER)).schema)),
    Key("with_hand_eye", Kind(list_of(list_of(NUMBER)).schema), when=lambda known: known.with_hand_eye.size),
)
_OUTLIER = Document(Key("view", TEXT), Key("target", Kind({"type": ["string", "null"]})))
_DISAGREEMENT = Kind({"type": ["object", "null"], "properties": {"gate": NUMBER.schema}})
_PATH = Kind(
    {"type": "string", "pattern": "^[^\\u0000]+$", "maxLength": 4000}, lambda session: str(session.path.resolve())
)
# A sigma is null where the views do not show it.
_AXIS = Kind({}, lambda place: {key: plain(value) for key, value in vars(place).items() if value is not None})
_SIZES = Kind({"type": "object"}, _sizes)
_NUMBERS = Kind(list_of(NUMBER_OR_NULL).schema, read=lambda values: [number(value) for value in values])
# Lengths in length_unit, angles in rad; twists and covariances rotation first.
RESULT = Document(
    Key("format", write=lambda run: FORMAT),
    Key("session", _PATH, "session"),
    Key("sessions", list_of(_PATH), "session.parts", when=attrgetter("session.parts")),
    Key("scanner", attribute="session.scanner.name", when=attrgetter("session.scanner.name")),
    Key("scanners", write=_scanner_rows, when=attrgetter("session.parts")),
    Key("name", attribute="session.name"),
    Key("length_unit", attribute="session.length_unit"),
    Key("mount", attribute="session.mount"),
    Key("reference_frame", attribute="session.reference_frame"),
    Key("hand_eye", MATRIX, "T_mount"),
    Key("hand_eye_coarse", attribute="T_mount_coarse"),
    Key("hand_eye_sigma", write=lambda run: np.sqrt(np.diag(run.mount_covariance))),
    Key(
        "hand_eye_sigma_anywhere",
        array_of(6),
        "fit.sigma_anywhere",
        of=Fit,
        when=lambda r: r.fit.sigma_anywhere is not None,
    ),
    Key("hand_eye_covariance", attribute="mount_covariance"),
    Key("hand_eye_alone", _ALONE.kind(), write=_hand_eye_alone, when=_hand_eye_alone),
    Key("unobservable", TEXTS, of=Fit),
    Key("hand_eye_unknown", TEXTS, "unknown", of=Fit, optional=True),
    Key("hand_eye_stated", attribute="session.states_hand_eye"),
    Key("stages", _STAGE.rows(StageResult), of=Fit),
    Key("residual_rms", NUMBER, of=RunData),
    Key("heldout_rms", NUMBER_OR_NULL, of=RunData),
    Key("noise_floor", NUMBER, of=RunData),
    Key("gate", NUMBER_OR_NULL, of=RunData, optional=True),
    Key("repeatability", _SCATTER.kind(partial(Repeatability, noise_factor=float("nan"))), of=Fit),
    Key("effects", _EFFECTS, "terms"),
    Key("effects_covariance", _COVARIANCE.kind(), "model.effects_covariance", optional=True),
    Key("axes", list_of(_AXIS), when=attrgetter("session.axes")),
    Key("views", _VIEWS, write=_all_views),
    Key("left_out", _LEFT_OUT.rows(), optional=True),
    Key("stock", _STOCK.rows(), write=_stock_rows, when=lambda r: any(s.stock for s in r.measurement.capture.scans)),
    Key("linkage", _LINKAGE.kind(ViewLinks), "links", of=RunData, optional=True),
    Key("unsupported_points", _UNSUPPORTED.kind(Unsupported), "fit.unsupported", of=Fit, optional=True),
    Key("targets", write=_target_rows),
    Key("position_error", _SIZES, "targets.distances", when=attrgetter("targets")),
    Key("outliers", Kind(list_of(_OUTLIER.kind()).schema), write=_outlier_rows, when=attrgetter("targets")),
    Key("cloud_noise_factor", NUMBER, "measurement.capture.noise_factor", when=lambda r: r.targets and r.registered),
    Key("rms_of", write=lambda run: "3D distances of the targets from their place", when=_has_labelled_alone),
    Key("heldout_position_error", _SIZES, "targets.heldout", when=_has_labelled_alone),
    Key("convergence", table_of(_NUMBERS), of=Fit),
    Key("disagreement", _DISAGREEMENT, write=_disagreement, optional=True),
    Key("plain", write=lambda run: run_verdict(run, model_history(run))),
    Key("verdict", TEXT, of=Fit),
    Key("doubts", TEXTS, of=RunData, optional=True),
    Key("notes", TEXTS, of=Fit),
    Key("versions", write=lambda run: _versions()),
)

"""model.toml, the form of a model for people: read and written, and bound to a session.

Between the file and a session stand units, parameters that mean the same, and sigmas. `without_events` leaves behind
what happened at one view of a session; `keep_arm_effects` takes nothing but the arm of another run: its effects on
joints and links as they are, under another mount, tool or day.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from stitch.effects.contract import Effect, Parameter, find_effect, parameters_in, require_available
from stitch.errors import InputError
from stitch.model.model import ARM_PLACES, EffectsCovariance, Model, Target, Term
from stitch.numerics import frames
from stitch.numerics.frames import Array, is_rigid
from stitch.numerics.units import METRES, length_power
from stitch.session.axis_poses import place_axes
from stitch.session.measurement import Measurement
from stitch.session.reading.text_files import optional_text, read_toml, table_choice
from stitch.session.session import SessionData
from stitch.system.values import Value

FORMAT = "stitch-model/1"
# What rounding, or a hand that writes six digits, does to a matrix of unit diagonal.
_ROUNDED = 1e-5
_HEADER = """# The model of this cell. hand_eye.corrected is {frame}: it maps scanner
# coordinates into the {carrier} frame. sigma and covariance belong to a right perturbation
# T·exp(ξ), ξ = (rotation in rad, translation in {unit}), in the scanner frame.
"""


@dataclass(frozen=True, eq=False)
class ModelFile(Value):
    """What model.toml says: the model with its unit and mount, parameters by effect and name.

    Example:
        >>> model = stitch.read_model(better.save(folder / "better", recording=False))
        >>> model.mount, model.T_mount.shape, list(model.effects["range_scale"])
        ('eye_in_hand', (4, 4), ['s'])
    """

    length_unit: str
    mount: str  # eye_to_hand | eye_in_hand
    T_mount: Array  # (4, 4) T_base_scanner or T_flange_scanner
    T_mount_coarse: Array  # (4, 4)
    covariance: Array  # (6, 6)
    effects: dict[str, dict[str, Parameter]] = field(default_factory=dict)
    effects_file: str | None = None  # Python file with effects of the user's own
    targets: dict[str, Target] = field(default_factory=dict)  # of a session with labelled points
    effects_covariance: EffectsCovariance = field(default_factory=EffectsCovariance)  # stands in result.json
    axes: dict[str, tuple[Array, Array | None]] = field(default_factory=dict)  # direction and point before placement
    scanners: dict[str, Array] = field(default_factory=dict)  # (4, 4) hand-eye of each of several before placement


def write_model(model: ModelFile, path: Path) -> None:
    """Write a model as `model.toml` at `path`, with comments on its frames, and all digits of its numbers."""
    carrier = "base" if model.mount == "eye_to_hand" else "flange"
    document = {
        "format": FORMAT,
        "length_unit": model.length_unit,
        "mount": model.mount,
        "hand_eye": {
            "corrected": model.T_mount.tolist(),
            "coarse": model.T_mount_coarse.tolist(),
            "sigma": np.sqrt(np.diag(model.covariance)).tolist(),
            "covariance": model.covariance.tolist(),
        },
        "effects": {
            name: {p: _parameter_table(f) for p, f in fitted.items()} for name, fitted in model.effects.items()
        },
    }
    if model.targets:
        targets = {name: {"position": t.position, "sigma": t.sigma} for name, t in model.targets.items()}
        for name, target in model.targets.items():
            if target.orientation is not None:
                targets[name]["orientation"] = target.orientation
        document["targets"] = {name: {k: v.tolist() for k, v in table.items()} for name, table in targets.items()}
    if model.axes:
        # Where the fit began; axis_placement counts from there.
        document["axes"] = {
            name: {"direction": direction.tolist(), **({} if point is None else {"point": point.tolist()})}
            for name, (direction, point) in model.axes.items()
        }
    if model.scanners:
        # Likewise for scanner_placement; hand_eye is that of the first.
        document["scanners"] = {name: {"hand_eye": T.tolist()} for name, T in model.scanners.items()}
    if model.effects_file:
        document["effects_file"] = model.effects_file
    header = _HEADER.format(frame=f"T_{carrier}_scanner", carrier=carrier, unit=model.length_unit)
    path.write_text(header + tomli_w.dumps(document), encoding="utf-8")


def _parameter_table(p: Parameter) -> dict[str, Any]:
    """Return the table of a parameter in model.toml; observable = false in place of a sigma that is NaN."""
    known = {"sigma": p.sigma} if p.fitted else {"observable": False}
    return {"value": p.value, **known, "unit": p.unit, **({"kept": True} if p.kept else {})}


def read_model(path: Path | str) -> ModelFile:
    """Read `model.toml`, or that of a run folder.

    Returns:
        The hand-eye T_mount (4, 4) in the mount frame, covariance (6, 6) in the scanner frame, and the parameters of
        the effects; lengths in its length_unit, angles in rad. `stitch.run` takes it as `model`.

    Raises:
        InputError: the file is missing, not a model, or a value cannot be: a hand-eye that is not a rigid motion.

    Example:
        >>> model = stitch.read_model(run.save(folder / "saved", recording=False))
        >>> bool((model.T_mount == run.T_mount).all()), model.length_unit
        (True, 'mm')
    """
    path = Path(path)
    path = path / "model.toml" if path.is_dir() else path
    document = read_toml(path, "name a run folder that `stitch run` wrote")
    if document.get("format") != FORMAT:
        raise InputError(f'{path}: format is {document.get("format")!r}, expected "{FORMAT}"; to fix: name a run')
    hand_eye = document.get("hand_eye", {})
    corrected = _matrix(path, hand_eye, "corrected", 4)
    coarse = _matrix(path, hand_eye, "coarse", 4) if "coarse" in hand_eye else corrected
    for name, T in (("corrected", corrected), ("coarse", coarse)):
        if not is_rigid(T):
            raise InputError(f"{path}: hand_eye.{name} is not a rigid motion; its 3x3 part must be a rotation")
    covariance = _matrix(path, hand_eye, "covariance", 6) if "covariance" in hand_eye else np.zeros((6, 6))
    sigma = np.sqrt(np.abs(np.diag(covariance)))
    unit = np.where(sigma > 0, sigma, 1.0)
    correlation = covariance / np.outer(unit, unit)
    if np.abs(correlation - correlation.T).max() > _ROUNDED or np.linalg.eigvalsh(correlation)[0] < -_ROUNDED:
        raise InputError(
            f"{path}: hand_eye.covariance is not symmetric, or negative in some direction; to fix: copy that of the run"
        )
    return ModelFile(
        length_unit=table_choice(path, document, "length_unit", tuple(METRES)),
        mount=str(document.get("mount")),
        T_mount=corrected,
        T_mount_coarse=coarse,
        covariance=covariance,
        effects=_effects(path, document.get("effects", {})),
        effects_file=optional_text(path, document, "", "effects_file"),
        targets=_targets(path, document.get("targets", {})),
        axes=_axes(path, document.get("axes", {})),
        scanners={
            str(name): _matrix(path, table if isinstance(table, dict) else {}, "hand_eye", 4)
            for name, table in document.get("scanners", {}).items()
        },
    )


@contextmanager
def _tables(path: Path, name: str, form: str) -> Iterator[None]:
    """Turn an error in the block that reads tables of model.toml into an InputError of one line.

    Args:
        name: of the tables.
        form: how they should look, for the message.
    """
    try:
        yield
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: {name} must be tables such as {form}") from None


def _axes(path: Path, tables: Any) -> dict[str, tuple[Array, Array | None]]:
    """Return axis name -> direction (3,) and point (3,), None if not stated, from the tables [axes] of model.toml.

    Raises:
        InputError: other than three finite numbers each.
    """
    with _tables(path, "axes", "[axes.table] with direction, point; to fix: three numbers each"):
        axes = {
            str(name): (np.array(t["direction"], float), np.array(t["point"], float) if "point" in t else None)
            for name, t in tables.items()
        }
        if any(v is not None and (v.shape != (3,) or not np.isfinite(v).all()) for pair in axes.values() for v in pair):
            raise ValueError
    return axes


def with_model_axes(session: SessionData, file: ModelFile) -> SessionData:
    """Return the session with its axes placed as in the model: the parameters of axis_placement count from there.

    Raises:
        InputError: session and model have other axes.
    """
    here, known = [axis.name for axis in session.axes], list(file.axes)
    if sorted(here) != sorted(known):
        raise InputError(
            f"{session.path}: its axes are {', '.join(here) or 'none'}, those of the model {', '.join(known) or 'none'}"
            "; to fix: give both the same [[axis]] tables"
        )
    if not here:
        return session
    return place_axes(
        session, [replace(a, direction=file.axes[a.name][0], point=file.axes[a.name][1]) for a in session.axes]
    )


def with_model_scanners(sessions: Sequence[SessionData], file: ModelFile) -> list[SessionData]:
    """Return the sessions of several scanners in the model's order, each with the hand-eye that the model states.

    The parameters of scanner_placement count from these.

    Raises:
        InputError: a scanner that the model does not know.
    """
    unknown = [session for session in sessions if session.scanner.name not in file.scanners]
    if unknown:
        raise InputError(
            f"{unknown[0].path}: scanner {unknown[0].scanner.name!r} is none of the model's, "
            f"{', '.join(file.scanners) or 'which has one'}; to fix: name the run of the same scanners"
        )
    order = list(file.scanners)
    ranked = sorted(sessions, key=lambda session: order.index(session.scanner.name))
    return [replace(s, scanner=replace(s.scanner, T_mount=file.scanners[s.scanner.name])) for s in ranked]


def _targets(path: Path, table: Any) -> dict[str, Target]:
    """Return target name -> target from the table [targets] of model.toml.

    Raises:
        InputError: a position that is not three numbers, or an orientation that is not 3×3.
    """
    targets = {}
    with _tables(path, "targets", "[targets.ball1] with position, sigma; to fix: three numbers each"):
        for name, t in table.items():
            orientation = np.array(t["orientation"], float) if "orientation" in t else None
            targets[str(name)] = Target(np.array(t["position"], float), np.array(t["sigma"], float), orientation)
            if targets[name].position.shape != (3,) or (orientation is not None and orientation.shape != (3, 3)):
                raise ValueError
    return targets


def _effects(path: Path, table: Any) -> dict[str, dict[str, Parameter]]:
    """Return effect name -> parameter name -> parameter from the table [effects] of model.toml.

    Only names, units, values and sigmas are read: plausible sizes come with the session (`bind_to_session`).

    Raises:
        InputError: a value that is not finite, or a sigma that is none.
    """
    with _tables(path, "effects", "[effects.joint_compliance.c2]; to fix: value, sigma, unit in each"):
        effects = {
            str(name): {
                str(p): Parameter(
                    str(p),
                    str(f.get("unit", "")),
                    value=float(f["value"]),
                    sigma=float(f.get("sigma", np.nan)),
                    kept=f.get("kept") is True,
                )
                for p, f in parameters.items()
            }
            for name, parameters in table.items()
        }
    for name, parameters in effects.items():
        for p in parameters.values():
            if not np.isfinite(p.value) or p.sigma < 0 or np.isinf(p.sigma):
                sigma = f" with sigma {p.sigma:g}" if np.isfinite(p.value) else ""
                number = f"effects.{name}.{p.name} is {p.value:g}{sigma}"
                raise InputError(f"{path}: {number}; to fix: copy that of the run")
    return effects


def _matrix(path: Path, table: dict[str, Any], key: str, size: int) -> Array:
    """Return a matrix (size, size) of the table hand_eye.

    Raises:
        InputError: it is missing, of another shape, or not finite.
    """
    try:
        matrix = np.array(table[key], float)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: hand_eye.{key} is no {size}x{size} list of numbers; to fix: write one") from None
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        shape = "x".join(map(str, matrix.shape))
        raise InputError(f"{path}: hand_eye.{key} is {shape}, or not finite; to fix: {size}x{size} finite numbers")
    return matrix


def without_events(file: ModelFile) -> ModelFile:
    """Return the model for another session: without effects that begin at one view of its own session, its events.

    What an event of the mount moved is added to the hand-eye, what one of the part moved to the targets, so that both
    are as after the last view.

    Raises:
        InputError: an effect that is not known.
    """
    events = [name for name, parameters in file.effects.items() if any(p.discrete for p in parameters.values())]
    targets, T_mount = file.targets, file.T_mount
    for name in events:
        moved = [p.value for p in file.effects[name].values() if not p.discrete]
        place = find_effect(name).place
        if place == "part" and len(moved) == 6:
            T = frames.exp(np.array(moved))
            targets = {key: _moved_target(target, T) for key, target in targets.items()}
        if place == "mount" and len(moved) == 6:
            T_mount = T_mount @ frames.exp(np.array(moved))
    rest = {k: v for k, v in file.effects.items() if k not in events}
    return replace(file, effects=rest, targets=targets, T_mount=T_mount)


def _moved_target(target: Target, T: Array) -> Target:
    """Return a target moved by T (4, 4) in the reference frame."""
    orientation = None if target.orientation is None else T[:3, :3] @ target.orientation
    return replace(target, position=frames.transform(T, target.position), orientation=orientation)


def keep_arm_effects(file: ModelFile) -> ModelFile:
    """Return the model with nothing but the effects of its arm, which other sessions then use and do not fit.

    Raises:
        InputError: an effect that is not known, or none of the arm.
    """
    arm = arm_model(file)
    if arm is None:
        used = ", ".join(file.effects) or "none"
        raise InputError(
            f"--arm: the model has no effect of joints or links (its effects: {used}); to fix: name the run of a "
            "session that showed them, after `stitch add`"
        )
    return arm


def arm_model(file: ModelFile) -> ModelFile | None:
    """Return the model with the effects of its arm alone, marked `kept`: used as they are, not fitted; without targets.

    None where it has no effect of base, joints or links.

    Raises:
        InputError: an effect that is not known.
    """
    effects = {
        name: {key: replace(p, kept=True) for key, p in parameters.items()}
        for name, parameters in without_events(file).effects.items()
        if find_effect(name).place in ARM_PLACES
    }
    return replace(file, effects=effects, targets={}) if effects else None


def bind_to_session(file: ModelFile, measurement: Measurement) -> Model:
    """Return the model that a file states, for a session: with plausible sizes and grids of its effects there.

    A parameter that the file does not name is held at 0.

    Raises:
        InputError: an effect that is not known or that the session cannot have, or a parameter that it does not have
            or counts in another unit.
    """
    terms = []
    for name, stated in file.effects.items():
        effect = find_effect(name)
        require_available(measurement, effect)
        parameters = parameters_in(measurement, effect)
        _require_same(measurement, effect, stated, {p.name: p.unit for p in parameters})
        filled = [
            replace(p, value=s.value, sigma=s.sigma, kept=s.kept) if (s := stated.get(p.name)) else p
            for p in parameters
        ]
        terms.append(Term(effect, tuple(filled)))
    return Model(file.T_mount, tuple(terms), file.covariance, file.targets, file.effects_covariance)


def _require_same(
    measurement: Measurement, effect: Effect, stated: dict[str, Parameter], units: dict[str, str]
) -> None:
    """Refuse parameters of a model that an effect has not in this session, or has in another unit.

    Args:
        stated: parameter name -> parameter of the model.
        units: parameter name -> unit in this session.

    Raises:
        InputError: names the parameters, and how to make the sessions agree.
    """
    where = f"session {measurement.capture.name}"
    lost = [name for name in stated if name not in units]
    if lost:
        raise InputError(
            f"the model's {effect.name} has {', '.join(lost)}, but in {where} it has {', '.join(units)}; state the arm "
            "and its link masses under [robot] as the session that was fitted does, or fit the effect anew"
        )
    for name, p in stated.items():
        if p.unit != units[name]:
            fix = f"a column {' or '.join(effect.prefers)} there as here" if effect.prefers else "that unit"
            raise InputError(
                f"the model's {effect.name}.{name} is in {p.unit!r}, but {where} counts it in {units[name]!r}; "
                f"it needs {fix}"
            )


def convert_unit(file: ModelFile, length_unit: str) -> ModelFile:
    """Return the model with all lengths in another unit, `length_unit`: hand-eye, effects, targets and covariances."""
    if file.length_unit == length_unit:
        return file
    factor = METRES[file.length_unit] / METRES[length_unit]
    scale = np.array([1.0] * 3 + [factor] * 3)
    hand_eyes = [file.T_mount.copy(), file.T_mount_coarse.copy()]
    for T in hand_eyes:
        T[:3, 3] *= factor
    known = file.effects_covariance
    units = {f"{name}.{key}": p.unit for name, parameters in file.effects.items() for key, p in parameters.items()}
    factors = np.array([factor ** length_power(units.get(name, ""), file.length_unit) for name in known.names])
    beside = np.append(scale, factors)
    return replace(
        file,
        length_unit=length_unit,
        T_mount=hand_eyes[0],
        T_mount_coarse=hand_eyes[1],
        covariance=file.covariance * np.outer(scale, scale),
        effects={
            name: {key: _rescaled(p, file.length_unit, length_unit, factor) for key, p in parameters.items()}
            for name, parameters in file.effects.items()
        },
        effects_covariance=replace(
            known,
            matrix=known.matrix * np.outer(factors, factors),
            with_hand_eye=known.with_hand_eye * np.outer(scale, beside[: known.with_hand_eye.shape[1]]),
        ),
        axes={name: (d, None if point is None else point * factor) for name, (d, point) in file.axes.items()},
        scanners={name: frames.make(T[:3, :3], T[:3, 3] * factor) for name, T in file.scanners.items()},
        targets={
            name: Target(t.position * factor, t.sigma * factor, t.orientation) for name, t in file.targets.items()
        },
    )


def _rescaled(p: Parameter, old: str, new: str, factor: float) -> Parameter:
    """Return a parameter with its lengths in unit `new` instead of `old`; `factor` is one `old` in units `new`."""
    power = length_power(p.unit, old)
    unit = "/".join(new if part.strip() == old else part for part in p.unit.split("/"))
    return replace(p, unit=unit, value=p.value * factor**power, sigma=p.sigma * factor**power)

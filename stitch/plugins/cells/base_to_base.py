"""`stitch base`: both solutions of one stand, after the check that its readings belong together."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.cli.terminal import say, show_table
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import normal_tail
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.output.session_files import SessionFiles, pose_columns
from stitch.plugins.cells.job_files import (
    JobTable,
    Wanted,
    checked_table,
    fixed_digits,
    hand_out,
    points_table,
    read_job_file,
    write_recording_and_page,
)
from stitch.plugins.cells.stand import (
    BaseFit,
    DhArm,
    DistanceComparison,
    Projection,
    Stand,
    TouchedPoints,
    compare_distances,
    cylinder_covariance,
    cylinder_points,
    fit_stand,
    project,
    rail_direction,
)

# A distance that differs by more than this many sigmas is a wrong reading, not noise (one in two million).
CONTRADICTION_SIGMAS = 5.0
STAND_FORMAT = "stitch-base/1"
# Sigmas of a careful operator where the file states none: the source sees 0.1 to 0.2 mm as the smallest distance
# that an eye can tell, and calls its distance and angle sensors better than that.
_POINT = _SLIDE = _LENGTH = _ANGLE = 1e-4
_LEVEL = 1e-3
_KEYS = {"format", "length_unit", "angle_unit", "main", "second", "rod", "level"}
_TURN = {"clockwise": 1.0, "anticlockwise": -1.0}
_CYLINDER = ("joint1", "radius", "height")


@dataclass(frozen=True)
class BaseResult:
    """Both solutions and the comparisons behind them."""

    length_unit: str
    fit: BaseFit
    projection: Projection | None
    no_projection: str | None  # why there is none
    comparisons: tuple[DistanceComparison, ...]
    flange_rpy: dict[str, list[float]]  # α, β, γ by the points that joint angles or rpy gave


def solve_stand(stand: Stand) -> BaseResult:
    """Check, then solve by least squares and, where it applies, by the source's projection.

    Raises:
        NoResultError: the readings contradict each other, or leave the second base open.
    """
    for touched in (stand.rail, stand.rod):
        if touched.rpy is not None:
            _check_pins(touched.names, touched.rpy)
    comparisons = compare_distances(stand)
    wrong = [c for c in comparisons if c.sigmas > CONTRADICTION_SIGMAS]
    if wrong:
        texts = "; ".join(comparison_text(c, stand.length_unit) for c in wrong)
        raise NoResultError(
            f"rod and joints contradict each other: {texts}. No transform is given; to fix: read these points again"
        )
    solution = fit_stand(stand)
    if solution.p_value < 2 * normal_tail(CONTRADICTION_SIGMAS):
        sizes = np.linalg.norm(np.vstack([solution.rail_residuals, solution.rod_residuals]), axis=1)
        worst = int(np.argmax(sizes))
        raise NoResultError(
            f"the readings contradict each other: chi-square {solution.chi_square:.1f} with {solution.redundancy} "
            f"redundant readings; the largest misfit is {sizes[worst]:.4g} {stand.length_unit} at "
            f"{(stand.rail.names + stand.rod.names)[worst]}; to fix: read that point again, or state larger sigmas"
        )
    turns: dict[str, list[float]] = {}
    for touched in (stand.rail, stand.rod):
        if touched.rpy is not None:
            turns |= zip(touched.names, touched.rpy.tolist(), strict=True)
    projection = no_projection = None
    try:
        projection = project(stand)
    except NoResultError as error:
        no_projection = str(error)
    return BaseResult(stand.length_unit, solution, projection, no_projection, comparisons, turns)


def _check_pins(names: tuple[str, ...], rpy: Array) -> None:
    """Refuse flanges of one robot that point against each other: a pin enters its cups from one side.

    The rod and the slide hold nothing against a joint of the wrong sign, which leaves the distances possible.
    """
    axes = Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()[:, :, 2]
    against = np.argwhere(axes @ axes.T < 0)
    if len(against):
        first, second = (names[i] for i in against[0])
        raise NoResultError(
            f"the flange at {second} points against the one at {first}, but a pin enters its cups from one side; to "
            "fix: check the signs of the joint angles there"
        )


def comparison_text(c: DistanceComparison, unit: str) -> str:
    """Say one comparison in words and numbers."""
    a, b = c.pair
    return (
        f"{a} to {b} is {c.by_stand:.4f} {unit} by the stand and {c.by_robot:.4f} {unit} by the robot, a difference of "
        f"{c.difference:+.4f} {unit} or {c.sigmas:.1f} sigma"
    )


def base_document(result: BaseResult) -> dict[str, Any]:
    """Return plain numbers for JSON: lengths in length_unit, angles in rad."""
    solution = result.fit
    projection = result.projection
    planes = projection and {
        "T_base1_base2": projection.T_base1_base2.tolist(),
        "gamma_beta_alpha": [None if np.isnan(a) else float(a) for a in projection.gamma_beta_alpha],
        "offsets": projection.offsets.tolist(),
        "flange_beta_alpha": None if (tilt := projection.flange_beta_alpha) is None else tilt.tolist(),
    }
    return {
        "length_unit": result.length_unit,
        "T_base1_base2": solution.T_base1_base2.tolist(),
        "sigma": {"rotation": solution.sigma[:3].tolist(), "translation": solution.sigma[3:].tolist()},
        "covariance": solution.covariance.tolist(),
        "T_base1_stand": solution.T_base1_stand.tolist(),
        "flange_rpy": result.flange_rpy,
        "rail_residuals": solution.rail_residuals.tolist(),
        "rod_residuals": solution.rod_residuals.tolist(),
        **{key: getattr(solution, key) for key in ("chi_square", "redundancy", "p_value")},
        "projection": planes,
        "no_projection": result.no_projection,
        "distances": [vars(c) | {"sigmas": c.sigmas} for c in result.comparisons],
    }


def rod_session(stand: Stand, result: BaseResult) -> SessionFiles:
    """Return one view for each rod setting; the sensor's frame is the stand's.

    The readings tell where the tip was, not how it was turned: its frame is taken parallel to the base, which changes
    nothing, because the target lies in its origin.
    """
    across = stand.length * stand.sigma_angle
    sigma = np.sqrt((stand.sigma_length**2 + across**2 + stand.sigma_slide**2) / 3)
    T_base2_stand = frames.inverse(result.fit.T_base1_base2) @ result.fit.T_base1_stand
    T_base2_tip = frames.make(np.tile(np.eye(3), (len(stand.cups), 1, 1)), stand.rod.points)
    names = stand.rod.names
    return SessionFiles(
        name="rod",
        length_unit=stand.length_unit,
        mount="eye_to_hand",
        tables={"scanner": {"pose": T_base2_stand.tolist()}},
        views={"view": names, **pose_columns(T_base2_tip)},
        points=points_table(names, ["tip"] * len(names), stand.cups, sigma),
        targets={"tip": np.zeros(3)},
    )


def read_stand(file: Path | str) -> Stand:
    """Read and check a stand file.

    Raises:
        InputError: the file is missing, not TOML, or an entry is missing, unknown, not a number or impossible.
    """
    file = Path(file)
    document = read_job_file(file, STAND_FORMAT, _KEYS, "examples/base_to_base.toml")
    unit = METRES[document.choice("length_unit", METRES)]
    to_rad = 1.0 if document.choice("angle_unit", ("rad", "deg")) == "rad" else float(np.pi / 180)
    rail, rail_entries = _touched_points(document, "main", {"slide"}, unit, to_rad)
    rod, rod_entries = _touched_points(document, "second", {"slide", "angle", "length"}, unit, to_rad)
    settings = document.table("rod", {"turn", "sigma_slide", "sigma_angle", "sigma_length"}, required=True)
    level = document.table("level", {"stand", "second_base"})
    stand = Stand(
        length_unit=str(document.entries["length_unit"]),
        rail=rail,
        rail_slide=np.array([e.number("slide") if "slide" in e else np.nan for e in rail_entries]),
        rod=rod,
        slide=_column(rod_entries, "slide"),
        angle=_column(rod_entries, "angle") * to_rad,
        length=_column(rod_entries, "length", positive=True),
        turn=_TURN[settings.choice("turn", _TURN, "clockwise")],
        sigma_slide=settings.number("sigma_slide", _SLIDE / unit, positive=True),
        sigma_angle=settings.number("sigma_angle", _ANGLE / to_rad, positive=True) * to_rad,
        sigma_length=settings.number("sigma_length", _LENGTH / unit, positive=True),
        sigma_level_stand=level.number("stand", _LEVEL / to_rad, positive=True) * to_rad,
        sigma_level_base=level.number("second_base", positive=True) * to_rad if "second_base" in level else None,
        file=file,
    )
    _check_geometry(file, stand)
    return stand


def _touched_points(
    document: JobTable, name: str, readings: set[str], unit: float, to_rad: float
) -> tuple[TouchedPoints, list[JobTable]]:
    """Read the points of one robot, from coordinates or from joint 1, radius and height.

    Args:
        unit, to_rad: metres per length unit and rad per angle unit.
    """
    robot = document.table(name, {"points", "sigma", "arm"}, required=True)
    rows = robot.entries.get("points")
    if not isinstance(rows, list) or len(rows) < 2:
        raise InputError(f"{document.file}: [[{name}.points]] has fewer than two entries; to fix: add one")
    sigma = robot.table("sigma", {"point", "joint", *_CYLINDER})
    known = {"name", "point", "rpy", "joints", *_CYLINDER, *readings}
    entries = [checked_table(document.file, f"{name}.points[{i + 1}]", row, known) for i, row in enumerate(rows)]
    names = tuple(str(entry.entries.get("name", f"{name} {i + 1}")) for i, entry in enumerate(entries))
    rpy = _stated_flange_angles(entries, by_joints="arm" in robot)
    if "arm" in robot:
        return _points_of_joints(robot, entries, names, sigma, unit=unit, to_rad=to_rad), entries
    points: list[Array] = []
    covariances: list[Array] = []
    for entry in entries:
        if "point" in entry:
            points.append(entry.vectors("point", (3,), "three numbers [x, y, z] in the robot's base frame"))
            covariances.append(np.eye(3) * sigma.number("point", _POINT / unit, positive=True) ** 2)
            continue
        for key in _CYLINDER:
            if key not in entry:
                raise InputError(
                    f"{document.file}: {entry.place}.{key} is missing; to fix: give point = [x, y, z] or joint1, "
                    "radius and height"
                )
        joint1, radius, height = (entry.number(key, positive=key == "radius") for key in _CYLINDER)
        points.append(cylinder_points(joint1 * to_rad, radius, height))
        default = sigma.entries.get("point", _POINT / unit)
        spread = (
            sigma.number("joint1", default / radius / to_rad, positive=True) * to_rad,
            sigma.number("radius", default, positive=True),
            sigma.number("height", default, positive=True),
        )
        covariances.append(cylinder_covariance(joint1 * to_rad, radius, spread))
    turns = None if rpy is None else rpy * to_rad
    return TouchedPoints(names, np.array(points, float), np.array(covariances, float), turns), entries


def _stated_flange_angles(entries: list[JobTable], by_joints: bool) -> Array | None:
    """Read α, β, γ (N, 3) as the controller shows them, in the file's unit; None where no point states them."""
    stated = [entry for entry in entries if "rpy" in entry]
    if stated and (by_joints or len(stated) < len(entries)):
        raise stated[0].refusal("rpy", "state it at every point of this robot, and not beside joints")
    form = "[α, β, γ], the flange's turn about x, y, z"
    return np.array([entry.vectors("rpy", (3,), form) for entry in stated]) if stated else None


def _points_of_joints(
    robot: JobTable, entries: list[JobTable], names: tuple[str, ...], sigma: JobTable, *, unit: float, to_rad: float
) -> TouchedPoints:
    """Return where the tip stood by the joints' angles and the arm's DH rows, and how the flange was turned."""
    table = robot.table("arm", {"dh", "joints", "tip"})
    entry_rows = table.entries.get("joints")
    if not isinstance(entry_rows, list) or not entry_rows:
        raise table.refusal("joints", "list the DH rows, as { a = 0.3, alpha_deg = -90, d = 0.5, theta_deg = 0 }")
    place = f"{table.place}.joints"
    rows = [
        checked_table(robot.file, f"{place}[{i + 1}]", row, {"a", "alpha_deg", "d", "theta_deg", "slides"})
        for i, row in enumerate(entry_rows)
    ]
    slides = np.array([row.entries.get("slides", False) is True for row in rows])
    arm = DhArm(
        a=np.array([row.number("a", 0.0) for row in rows]),
        alpha=np.radians([row.number("alpha_deg", 0.0) for row in rows]),
        d=np.array([row.number("d", 0.0) for row in rows]),
        theta=np.radians([row.number("theta_deg", 0.0) for row in rows]),
        slides=slides,
        modified=table.choice("dh", ("standard", "modified"), "standard") == "modified",
        tip=table.vectors("tip", (3,), "[x, y, z] in the flange frame") if "tip" in table else np.zeros(3),
    )
    form = f"{len(rows)} numbers, one for each DH row"
    units = np.where(slides, 1.0, to_rad)
    joints = np.array([entry.vectors("joints", (len(rows),), form) for entry in entries]) * units
    point = sigma.number("point", _POINT / unit, positive=True)
    reach = max(float(np.linalg.norm(arm.flange(joints)[:, :3, 3], axis=1).max()), point)
    turning = sigma.number("joint", point / reach / to_rad, positive=True) * to_rad
    points, covariance, rpy = arm.touched(joints, np.where(slides, point, turning))
    # The tip finds a cup to within the touch's own sigma, which also keeps the covariance regular.
    return TouchedPoints(names, points, covariance + np.eye(3) * point**2, rpy)


def _column(entries: list[JobTable], key: str, positive: bool = False) -> Array:
    for entry in entries:
        if key not in entry:
            raise InputError(
                f"{entry.file}: {entry.place}.{key} is missing; to fix: give every point of the rod slide, angle and "
                "length"
            )
    return np.array([entry.number(key, positive=positive) for entry in entries])


def _check_geometry(file: Path, stand: Stand) -> None:
    """Refuse points that leave the rail without a line, a zero or a level."""
    rail = stand.rail.points
    extent = float(np.linalg.norm(rail - rail.mean(axis=0), axis=1).max())
    if extent < 100 * np.sqrt(np.trace(stand.rail.covariance[0]) / 3):
        raise InputError(
            f"{file}: main.points lie within {2 * extent:.3g}; to fix: measure points farther apart on the rail"
        )
    if not np.isfinite(stand.rail_slide).any():
        raise InputError(
            f"{file}: no main point has a slide reading; to fix: write slide = 0 at the one that sets the zero"
        )
    x = rail_direction(rail)
    read = stand.rail_slide[np.isfinite(stand.rail_slide)]
    if np.isnan(stand.rail_slide[-1]) or (np.diff(rail @ x) <= 0).any() or (np.diff(read) <= 0).any():
        raise InputError(
            f"{file}: main.points must be listed in the direction in which the slide grows, the last with its slide "
            "reading; to fix: reorder them, or correct a slide reading"
        )
    if abs(x[2]) > 0.9:
        raise InputError(
            f"{file}: the rail stands upright in the main base; to fix: correct its points, for a rail lies level"
        )


def run_base(file: Path, wanted: Wanted) -> None:
    """Solve a stand and hand out what was asked for; `InputError` and `NoResultError` end it."""
    stand = read_stand(file)
    try:
        result = solve_stand(stand)
    except NoResultError:
        # The page shows which readings contradict each other.
        write_recording_and_page("base", None, wanted.report, stand, None)
        raise
    if hand_out("base", wanted, lambda: [rod_session(stand, result)], lambda: base_document(result), stand, result):
        _show_solution(result)


def _show_solution(result: BaseResult) -> None:
    unit = result.length_unit
    solution = result.fit
    rows = [
        ("least squares", solution.T_base1_base2[:3, 3], frames.log(solution.T_base1_base2)[:3]),
        ("  1 σ", solution.sigma[3:], solution.sigma[:3]),
    ]
    if result.projection is not None:
        T = result.projection.T_base1_base2
        rows.append(("projection", T[:3, 3], frames.log(T)[:3]))
    show_table(
        "T_base1_base2, translation and turn about the axes of base 1",
        ("solution", f"x y z / {unit}", "rotation vector / rad"),
        [(name, fixed_digits(shift, 5), fixed_digits(turn, 6)) for name, shift, turn in rows],
    )
    say(
        f"chi-square {solution.chi_square:.2f} with {solution.redundancy} redundant readings, p = "
        f"{solution.p_value:.2g}."
    )
    for comparison in result.comparisons:
        say(comparison_text(comparison, unit) + ".")
    for name, angles in result.flange_rpy.items():
        say(f"{name}: flange turned by α β γ {fixed_digits(np.array(angles), 4)} rad about x, y, z.")
    if result.projection is not None:
        for line in _plane_lines(result.projection, unit):
            say(line)
    if result.no_projection:
        say(f"No projection: {result.no_projection}.")
    for row in solution.T_base1_base2:
        print(" ".join(f"{value:.9g}" for value in row))


def _plane_lines(projection: Projection, unit: str) -> Iterator[str]:
    """Say what the planes beside X-Y show, and the flanges."""
    _, beta, alpha = projection.gamma_beta_alpha
    for (plane, angle), offsets in zip((("X-Z: β", beta), ("Y-Z: α", alpha)), projection.offsets[1:], strict=True):
        size = "open, taken as level" if np.isnan(angle) else f"{fixed_digits(np.array([angle]), 6)} rad"
        yield f"{plane} {size}, {fixed_digits(offsets, 5)} {unit}."
    if projection.flange_beta_alpha is not None:
        yield f"By the pins, upright in their cups: β α {fixed_digits(projection.flange_beta_alpha, 6)} rad."

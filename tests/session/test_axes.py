"""External axes against closed forms and against a second kinematics; what session.toml says of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stitch
from data_synth.cells.axis_cell import TrueAxis, axis_cell, write_cell
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.session.axes import Axes, Axis
from stitch.session.axis_poses import axes_of, reported_poses

TABLE = Axis("table", "rotary", "part", np.array([0.0, 0.0, 1.0]), np.array([800.0, 50.0, 0.0]))
RAIL = Axis("E1", "linear", "robot", np.array([0.0, 1.0, 0.0]))


def test_a_quarter_turn_of_a_table_carries_a_point_about_its_axis():
    axes = Axes((TABLE,), np.array([[np.pi / 2]]), np.zeros((1, 1)))
    at = frames.transform(frames.inverse(axes.carried())[0], np.array([[900.0, 50.0, 7.0]]))
    assert np.allclose(at, [[800.0, 150.0, 7.0]], atol=1e-9)


def test_a_rail_adds_its_way_to_the_robot_and_a_table_takes_its_turn_off_the_part():
    axes = Axes((RAIL, TABLE), np.array([[120.0, 0.3]]), np.zeros((1, 2)))
    turned = frames.make(Rotation.from_rotvec([0, 0, 0.3]).as_matrix(), np.zeros(3))
    about = frames.make(np.eye(3), TABLE.point)
    expected = frames.inverse(about @ turned @ frames.inverse(about)) @ frames.make(np.eye(3), [0, 120.0, 0])
    assert np.allclose(axes.carried()[0], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("axis", "fault", "effect", "values"),
    [
        ("linear", {"axis_scale": [3e-4]}, "axis_scale", {"s": [3e-4]}),
        ("linear", {"axis_pitch": [3e-4, -2e-4, 1e-4]}, "axis_pitch", None),
        ("linear", {"axis_backlash": [0.07]}, "axis_backlash", {"b": [], "c": [0.07]}),
        ("rotary", {"axis_backlash": [2e-4]}, "axis_backlash", {"b": [2e-4], "c": []}),
    ],
)
def test_effects_of_an_axis_do_what_nature_does(axis, fault, effect, values):
    d = np.array([0.6, 0.0, 0.8])
    own = Axis("a", axis, "robot", d, np.array([10.0, 20.0, 30.0]) if axis == "rotary" else None)
    reading = np.array([[0.4 if axis == "rotary" else 350.0]])
    axes = Axes((own,), reading, np.ones((1, 1)))
    point = np.zeros(3) if own.point is None else own.point
    true = TrueAxis("a", axis, "robot", d, point, {key: np.array(x) for key, x in fault.items()})
    if values is None:
        # Turns along the way are counted in the axis' own frame.
        values = {"p": own.frame[:3, :3].T @ fault["axis_pitch"]}
    views = type("Views", (), {"axes": axes})()
    arguments = {key: np.array(x, float) for key, x in values.items()}
    motion = EFFECTS[effect].function(axes.as_read(), views, **arguments)
    assert np.allclose(axes.carried(motion)[0], true.motion(float(reading[0, 0]), 1.0), rtol=0, atol=1e-3)


def test_a_table_that_runs_out_along_a_line_is_what_turns_against_it_and_a_shift_of_the_part():
    """a·sin θ along u is half a vector that turns with the table, which a shifted part does, and half against it."""
    axes = Axes((TABLE,), np.linspace(0, 5, 9)[:, None], np.zeros((9, 1)))
    views = type("Views", (), {"axes": axes})()
    a = 0.2
    u = TABLE.frame[:3, 0]
    true = TrueAxis("table", "rotary", "part", TABLE.direction, TABLE.point)
    nature = np.array([true.motion(q, 0.0) for q in axes.readings[:, 0]])
    nature[:, :3, 3] += a * np.sin(axes.readings) * u
    effect = EFFECTS["axis_eccentricity"].function
    left, _ = axes.sides(effect(axes.as_read(), views, A=np.array([a / 2]), B=np.zeros(1)))
    on_part = frames.inverse(left) @ nature
    assert np.allclose(on_part, on_part[0], atol=1e-9)


def test_a_session_with_a_table_is_saved_and_read_with_reported_poses(tmp_path):
    cell = axis_cell("table-arm", 5, views=4, pixels=40)
    axis = cell.axes[0]
    table = {"direction": axis.direction.tolist(), "point": axis.point.tolist(), "stated": True}
    write_cell(tmp_path / "s", cell, [table], cell.T_mount)
    session = stitch.load_session(tmp_path / "s")
    assert np.allclose(reported_poses(session), cell.T_base_flange, atol=1e-9)
    again = session.save(tmp_path / "again")
    assert np.allclose([v.T_base_flange for v in again.views], [v.T_base_flange for v in session.views], atol=1e-9)
    assert again.axes[0].is_fixed and np.allclose(axes_of(again).readings[:, 0], cell.readings[:, 0])


def test_axes_alone_that_meet_at_the_origin_of_the_base_are_no_wrong_unit(tmp_path):
    cell = axis_cell("tilt-turn", 5, views=4, pixels=40)
    tables = [
        {"direction": cell.stated(axis)[0].tolist(), "point": [0.0, 0.0, 5.0 * k]} for k, axis in enumerate(cell.axes)
    ]
    write_cell(tmp_path / "s", cell, tables)
    session = stitch.load_session(tmp_path / "s")
    assert max(np.linalg.norm(view.T_base_flange[:3, 3]) for view in session.views) < 30


def test_arrays_with_an_axis_are_the_session_of_a_folder(tmp_path):
    cell = axis_cell("turntable", 5, views=4, pixels=40)
    direction, point = cell.in_scanner(cell.axes[0])
    table = {"direction": direction.tolist(), "point": point.tolist()}
    write_cell(tmp_path / "s", cell, [table])
    folder = stitch.load_session(tmp_path / "s")
    session = stitch.Session.from_arrays(
        [cloud.points for cloud in cell.clouds],
        None,
        mount="eye_to_hand",
        covariates={"table_deg": np.degrees(cell.readings[:, 0])},
        axes=[{"name": "table", "kind": "rotary", "carries": "part", **table}],
    )
    assert session.reference_frame == folder.reference_frame == "table"
    assert np.allclose([v.T_base_flange for v in session.views], [v.T_base_flange for v in folder.views], atol=1e-9)
    # The reference frame is the table's, its z the axis.
    assert np.allclose(session.scanner.T_mount @ np.append(point, 1), [0, 0, 0, 1], atol=1e-9)
    assert np.allclose(session.scanner.T_mount[:3, :3] @ direction, [0, 0, 1], atol=1e-9)


@pytest.fixture(scope="module")
def three_views():
    return axis_cell("table-arm", 5, views=3, pixels=20)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"kind": "spherical"}, "axis table: kind is .spherical.; use 'rotary' or 'linear'"),
        ({"carries": "scanner"}, "carries is .scanner.; use 'part' or 'robot'"),
        ({"direction": [0, 0, 0], "point": [0, 0, 0]}, "direction is zero"),
        ({"stated": True}, "stated = true needs direction and point"),
        ({"centre": [0, 0, 0]}, "unknown key .centre."),
        ({"kind": "linear", "point": [0, 0, 0]}, "a linear axis has a direction alone"),
        ({"name": "no.name"}, "needs a name of letters and digits"),
        ({"name": "drum"}, "axis drum has 0 columns of readings; to fix: give it one, drum_deg"),
    ],
)
def test_a_table_of_an_axis_that_cannot_be_is_refused_in_one_line(tmp_path, three_views, table, words):
    write_cell(tmp_path / "s", three_views, [table], three_views.T_mount)
    with pytest.raises(stitch.InputError, match=words) as refusal:
        stitch.load_session(tmp_path / "s")
    assert "\n" not in str(refusal.value)

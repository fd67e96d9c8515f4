"""Simulated cells of small clouds: their scenes, what nature draws in them, what can be seen at the least, the
hand-eye.

Evidence counts in views: a few thousand points a view show what millions would.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.harness import ROOT
from data_synth import kinematics, nature
from data_synth.fixtures.quiet_scenes import plan_for, small_scene
from data_synth.moment import Plan
from data_synth.scene import Scene, load_scene
from data_synth.simulate import Measured, simulate
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import form_weights
from stitch.diagnosis.sensitivity import least_noncentrality
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need
from stitch.effects.user_file import load
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.run_data import RunData
from stitch.session.measurement import Measurement

# The beams of brackets are written in other numbers than the library's.
LIBRARY = tuple(name for name in nature.LAWS if name in EFFECTS and not name.endswith(("_droop", "_bend")))
# Laws without a counterpart in the library, and what a user would write for them.
OUTSIDE = {"third_harmonic": "third_harmonic", "covariate_bias": "humidity_bias"}
# Noise that the model does not have, each about as large as the scanner's own.
HARD = {
    "correlated field": {"field_error": 0.02},
    "heavy tails": {"tail": 3.0},
    "edge bias": {"edge_bias": 0.05},
    "three times the repeatability": {"repeatability": 3.0},
}
HARD["all four"] = {key: value for kind in HARD.values() for key, value in kind.items()}
LAST_JOINT = "the last joint alone"
_USER = ROOT / "examples" / "effects"
_USUAL_SPREAD = 0.18  # of the brightness, in which nature counts it


def harder(scene: Scene, hard: str, useful: tuple[int, ...]) -> Scene:
    """Return a scene with harder noise, and with joints whose errors nature may draw."""
    changes = dict(HARD[hard]) if hard else {}
    factor = changes.pop("repeatability", 1.0)
    repeatability = (scene.repeatability[0] * factor, scene.repeatability[1] * factor)
    scanner = replace(scene.scanner, **changes)
    return replace(scene, scanner=scanner, repeatability=repeatability, useful=useful or scene.useful)


def measure(
    name: str, seed: int, hidden: dict[str, float], how: str = "", useful: tuple[int, ...] = (),
    chance: int | None = None,
) -> Measured:  # fmt: skip
    """Return one session of the views planned for a seed; `how` names hard noise or LAST_JOINT.

    Args:
        chance: seed of what nature and the instruments draw, if it is not that of the plan.
    """
    alone = how == LAST_JOINT
    plan, rail = plan_for(load_scene(name), seed)
    if alone:
        plan, rail = _last_joint_only(plan, rail)
    planned = (replace(plan, useful=useful or plan.useful), rail)
    scene = harder(small_scene(name), "" if alone else how, useful)
    return simulate(scene, hidden, seed if chance is None else chance, planned=planned)


def _last_joint_only(plan: Plan, rail: Array) -> tuple[Plan, Array]:
    """The first view's joints, and the last joint turning on by 360° in all."""
    joints = np.repeat(plan.joints[:1], len(plan.joints), axis=0)
    joints[:, -1] += np.linspace(0, 2 * np.pi, len(joints), endpoint=False)
    torque = kinematics.gravity_torques(plan.arm, joints)
    return replace(plan, joints=joints, torque=torque), np.full_like(rail, rail[0])


def drawn(
    name: str, plan: Plan, measurement: Measurement, laws: Sequence[str], chance: int
) -> dict[str, dict[str, float]]:
    """Return what nature draws for these laws, in this order, at amplitude 1 in this very cell, as a model counts
    it."""
    out = nature.draw(dict.fromkeys(laws, 1.0), 0.0, plan, np.random.default_rng([chance, 2]))[1]
    if "part_growth" in out:
        # About another origin than the part's own, growth is a motion too.
        off = measurement.scan_views[0].origin - load_scene(name).T_reference_part[:3, 3]
        out["part_growth"] |= dict(zip(("cx", "cy", "cz"), out["part_growth"]["g"] * off, strict=True))
    return out


def user_effect(law: str) -> str:
    """Load the example that describes a law outside the library; return its effect's name."""
    return load(_USER / f"{OUTSIDE[law]}.py")[0]


def smallest(linear: LinearModel, effect: str, true: dict[str, float]) -> float | None:
    """Return the factor on the parameters `true` that is detectable at the least; None where cell or belief cannot
    hold it."""
    if missing_need(linear.measurement, EFFECTS[effect]) or not true:
        return None
    candidate = candidate_of(linear, EFFECTS[effect])
    if candidate is None:
        return None
    linear = linear.restricted(linear.causes - {effect})
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    fitted = np.array([not p.grid for p in candidate.parameters])
    sizes = []
    for form, weight in zip(candidate.forms, form_weights(candidate), strict=True):
        # Forms that hold all of the truth, at the value of the grid that is nearest to it.
        off = np.abs(form.term.values - values)[~fitted].sum()
        if not values[fitted & ~form.keep].any():
            white = linear.residual(form.columns)
            freedom = linear.satterthwaite.degrees_of_freedom(linear.in_blocks(white))
            scales = regime_of(linear).scales
            least = least_noncentrality(white * form.sizes, float(weight), len(EFFECTS), freedom, scales)
            sizes.append((off, np.sqrt(least) / max(float(np.linalg.norm(white @ values[form.keep])), 1e-12)))
    nearest = min(off for off, _ in sizes)
    amplitude = float(min(size for off, size in sizes if off == nearest))
    # Four times that must still be of a size that somebody would believe.
    limits = np.array([p.limit for p in candidate.parameters])
    return amplitude if (np.abs(values) * 4 * amplitude < limits)[fitted].all() else None


def in_session_units(measured: Measured) -> dict[str, dict[str, float]]:
    """Return what is hidden, brightness counted as a session counts it: in its own standard deviations."""
    hidden = {name: dict(values) for name, values in measured.hidden.items()}
    if "intensity_bias" in hidden:
        spread = float(np.concatenate([cloud.intensity for cloud in measured.clouds]).std())
        hidden["intensity_bias"]["k"] *= spread / _USUAL_SPREAD
    return hidden


def hand_eye_error(measured: Measured, T_mount: Array) -> float:
    """Return the rms displacement (mm) of points of the field, half of it wide, by the error of the hand-eye."""
    field = _field(measured)
    moved = frames.transform(T_mount, field) - frames.transform(measured.T_mount, field)
    return float(np.sqrt((moved**2).sum(axis=1).mean()))


def hand_eye_sigma(measured: Measured, covariance: Array) -> float:
    """Return the same as a covariance (6, 6) of the right perturbation predicts it."""
    jacobians = [np.hstack([-frames.skew(p), np.eye(3)]) for p in _field(measured)]
    return float(np.sqrt(np.mean([np.trace(J @ covariance @ J.T) for J in jacobians])))


def _field(measured: Measured) -> Array:
    scanner = measured.scene.scanner
    half = scanner.standoff * np.tan(np.radians(scanner.field_of_view / 4))
    return np.array([[x, y, scanner.standoff] for x in (-half, half) for y in (-half, half)])


def hand_eye_chi_square(measured: Measured, state: RunData) -> float:
    """Return the error of the hand-eye against its covariance; 6 on the average where that is right."""
    xi = frames.log(frames.inverse(state.T_mount) @ measured.T_mount)
    return float(xi @ np.linalg.solve(state.mount_covariance, xi))

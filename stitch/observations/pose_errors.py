"""How an arm's poses may err beside white scatter, before anything was measured: the prior of pose errors of a rig.

No arm is right in every joint and every link, and what it does wrong it does again at the same pose. So the errors of
the views' poses are a sum of processes, each with a covariance of known shape and a size that the views tell
(Kennedy & O'Hagan 2001, J. R. Statist. Soc. B 63:425):

    arm       all joints and links a little wrong, as the library's effects describe it, all at once
    smooth    errors of joints and links that follow the joint angles smoothly, by no law that anybody wrote down
    wandering rotation and translation of the flange that views near in time share
    stop      rotation and translation that scans from the same pose share; only where poses repeat
    scatter   every joint anew in every view; by its lever it is no scatter of the flange that is alike in all poses

White scatter of the flange in every scan, and the sensor's noise, come with the observation.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np
from scipy.linalg import block_diag

from stitch.effects.contract import EFFECTS, Effect, missing_need
from stitch.model.forward import pose_derivatives
from stitch.model.model import Model, Term, term_of
from stitch.numerics import frames
from stitch.numerics.frames import Array, Mask
from stitch.numerics.kernels import (
    SmoothErrors,
    direction_kernel,
    exponential_kernel,
    load_kernel,
    periodic_kernel,
    process_covariance,
    rbf_joints,
    same_stop,
    short_range_kernel,
    two_joint_kernel,
)
from stitch.numerics.reml import ALWAYS_PRESENT, MAY_BE_ABSENT, FurtherPrior
from stitch.numerics.units import MILLIMETRES
from stitch.session.measurement import Measurement
from stitch.session.torques import STILL

# The component of errors that every joint makes anew in every view, and its usual σ as a share of a plausible joint
# offset: then the flange turns as much as `_ROTATION`.
JOINT_SCATTER, USUAL_JOINT_SCATTER = "joint scatter", 0.02
_OFFSET = "joint_offset"
# Effects that every arm has need no other covariates.
_ARM_COVARIATES = ("joints", "torque")
# Most of what an arm errs is geometry, about 90 % (Klimchik et al. 2012, Optimization of measurement configurations for
# geometrical calibration of industrial robot, who do not say whether of the size or its square). Of what gears, play,
# bending and all that is smooth might do, this share of σ is usual beside it, between the tenth and its root.
_BESIDE_GEOMETRY = 0.25
EFFECT_FAMILY = {"gear_eccentricity": "gears", "gear_harmonic": "gears", "backlash": "play", "settling": "play"}
# Usual σ of what wanders and of stops, rad and mm along each axis of the flange.
_ROTATION, _TRANSLATION = 2e-5, 0.02
# What wanders, with correlation times in steps from view to view: what the next views forget, and what lasts as long as
# a usual session. Each has a size of its own: how much neighbours differ says how large it is, its memory what of it
# all views share; with both in one size that was understated.
DRIFT_MEMORY = {"quickly wandering": 2.0, "slowly wandering": 20.0}
# Scales of the half-Cauchy priors: of the arm in plausible sizes of the library's effects; what is smooth is usually
# smaller.
_ARM_SCALE, SMOOTH_SCALE = 0.1, 0.03
# Components that the scans of a stop share.
STOP_COMPONENTS = ("stop rotation", "stop translation")
# Dense matrices of more views take minutes in a fit: there white scatter alone must do.
_MOST_VIEWS = 150
# A diagnosis scores every candidate beside all errors that poses may have, which takes a minute for so many views. From
# there on poses count as scattering independently, and effects are sought several at once (`diagnosis/regime.py`).
MANY_VIEWS = 100
_CONSTANT_EFFECTS = (_OFFSET, "link_geometry")
# Causes by what they are: what wanders in time, what the scans of a stop share, and all that is none of the arm's.
DRIFT, STOP = frozenset(DRIFT_MEMORY), frozenset(STOP_COMPONENTS)
NOT_OF_ARM = DRIFT | STOP | {JOINT_SCATTER}
# What a joint may follow that errs by no law that anybody wrote down: all joint angles smoothly, its own and one other,
# its own within a few degrees or in waves, the way it came, time, at each pose in another way or in the same, or what
# bends it.
ALL_ANGLES, OWN_ANGLE, TRAVEL, WITH_TIME = "all angles", "own angle", "the way it came", "time"
JOINT_LOAD, TWO_ANGLES, WAVES, TIME_ONLY = "its load", "its angle and another", "waves of its angle", "time alone"
# A joint that turns less stands still, rad: what follows its angle alone is the same in all views, and has a name.
_STATIONARY_RANGE = 1e-3
# Waves along a joint: two over its range at the least, half a wave more or less looks alike, none shorter than 10°.
_MIN_WAVES, _WAVE_STEP, _SHORTEST_PERIOD, _MAX_WAVES = 2.0, 0.5, float(np.radians(10.0)), 14.0


def arm_effects(measurements: Sequence[Measurement]) -> list[Effect]:
    """Return the physical effects of the library that every arm has: their parameters are one per joint or torque.

    They depend on joint angles and torques alone. An effect is left out if a session lacks what it needs.
    """
    of_arm = [e for e in EFFECTS.values() if e.tier == "physical" and e.place in ("robot", "links")]
    by_joints = [e for e in of_arm if e.needs and set(e.needs) <= set(_ARM_COVARIATES)]
    per_joint = [e for e in by_joints if all(spec.kind in ("joint", "torque") for spec in e.specs.values())]
    return [e for e in per_joint if not any(missing_need(m, e) for m in measurements)]


def effect_twists(measurement: Measurement, model: Model, centre: Array, effects: Sequence[Effect]) -> list[Array]:
    """Return per effect the left twists (6V, P) of the views about `centre`, for a plausible size of each parameter.

    Rotation (rad) before translation (length_unit), view after view, by the derivative at `model`.

    Args:
        centre: (3,) reference frame.
    """
    in_use: dict[str, Term] = {term.name: term for term in model.terms}
    terms = [in_use.get(effect.name) or term_of(measurement, effect) for effect in effects]
    derivatives = pose_derivatives(measurement, model, terms, centre)
    return [d.reshape(len(d), -1).T * term.typical for term, d in zip(terms, derivatives, strict=True)]


def joint_offset_twists(measurement: Measurement, model: Model, centre: Array) -> Array | None:
    """Return left twists (6V, n) of the views about `centre` (3,) for a plausible offset of each joint.

    Rotation (rad) before translation (length_unit), view after view. None where the session states no joints.
    """
    if not measurement.views.has("joints") or _OFFSET not in EFFECTS:
        return None
    return effect_twists(measurement, model, centre, [EFFECTS[_OFFSET]])[0]


def usual_twist(length_unit: str) -> Array:
    """Return how much a flange usually turns and moves in one view, (6,): rad before length_unit."""
    return np.repeat([_ROTATION, _TRANSLATION / MILLIMETRES[length_unit]], 3)


def flange_twists(measurements: Sequence[Measurement], centres: Sequence[Array]) -> Array:
    """Return left twists (6V, 6) of all views of a rig for usual rotations and translations of the flange.

    The columns are rotations about, then translations along, the flange's own x, y and z: sizes as in `usual_twist`.

    Args:
        centres: per session the point (3,) about which the twists turn, reference frame.
    """
    adjoints = [
        frames.adjoint_about(centre, m.capture.T_reference_flange)
        for m, centre in zip(measurements, centres, strict=True)
    ]
    return np.concatenate(adjoints).reshape(-1, 6) * usual_twist(measurements[0].length_unit)


def mean_square_per_axis(columns: Array, measurements: Sequence[Measurement], centres: Sequence[Array]) -> Array:
    """Return the variances (2,) of the flange's rotation (rad²) and translation (length_unit²) by n independent errors.

    They are per axis of the flange: means over the views and the three axes.

    Args:
        columns: (6V, n) left twists of the views for one sigma of each error.
        centres: per session the point (3,) about which these twists turn, reference frame.
    """
    per_usual_twist = flange_twists(measurements, centres).reshape(-1, 6, 6)
    # Twists of the flange in its own frame (V, 6, n): in multiples of the usual twist, then in rad and length_unit.
    of_flange = np.linalg.solve(per_usual_twist, columns.reshape(len(per_usual_twist), 6, -1))
    of_flange *= usual_twist(measurements[0].length_unit)[:, None]
    variances = (of_flange**2).sum(axis=2).mean(axis=0)
    return variances.reshape(2, 3).mean(axis=1)


def drift_kernel(measurements: Sequence[Measurement], memory: float) -> Array:
    """Return correlations (V, V) that fall exponentially with the time between two views; 0 between sessions.

    Args:
        memory: correlation time, in median steps from one view to the next.
    """
    times = [time_in_steps(m) for m in measurements]
    return block_diag(*(exponential_kernel(time, time, memory) for time in times))


def time_in_steps(measurement: Measurement) -> Array:
    """Return the times (V,) of the views in median steps from view to view; their order where no time is stated."""
    views, step = measurement.views, usual_time_step(measurement)
    return views.time / step if step > 0 else np.arange(views.count, dtype=float)


def usual_time_step(measurement: Measurement) -> float:
    """Return the median time from one view to the next, s; 0 where no time is stated."""
    steps = np.diff(measurement.views.time)
    return float(np.median(steps)) if measurement.views.has("time") and (steps > 0).any() else 0.0


def joint_processes(
    measurements: Sequence[Measurement], joints: Array, offsets: Array, joint_kernel: Array
) -> dict[str, SmoothErrors]:
    """Return random processes of the errors of each joint, by what the error depends on (`ALL_ANGLES`, `OWN_ANGLE`, …).

    They stand for errors that no effect of the library describes: each is a Gaussian process with the kernel named, of
    all joints or of those that move. None of them is a component of the prior of pose errors; diagnosis asks them.

    Args:
        joints: (V, n) rad of all views of the rig.
        offsets: (6V, n) left twists of the views per unit of each joint's error.
        joint_kernel: (V, V) correlations of a smooth function of all joint angles.
    """
    # By how much each joint turned from the view before: its sign is the direction in which it came.
    travel = joints - np.concatenate([m.views.previous for m in measurements])
    drift = drift_kernel(measurements, DRIFT_MEMORY["slowly wandering"])
    all_joints = tuple(range(joints.shape[1]))
    common_kernels = {ALL_ANGLES: joint_kernel, WITH_TIME: (1 + joint_kernel) / 2 * drift, TIME_ONLY: drift}
    processes = {name: SmoothErrors(offsets, kernel, all_joints) for name, kernel in common_kernels.items()}
    moving = tuple(map(int, np.flatnonzero(np.ptp(joints, axis=0) > _STATIONARY_RANGE)))
    if moving:
        of_angle = np.array([short_range_kernel(joints[:, k], joints[:, k]) for k in moving])
        of_direction = np.array([direction_kernel(joints[:, k], travel[:, k]) for k in moving])
        processes[OWN_ANGLE] = SmoothErrors(offsets[:, moving], of_angle, moving)
        processes[TRAVEL] = SmoothErrors(offsets[:, moving], of_direction, moving)
    # Joints drag each other. A function of two angles has few degrees of freedom, one of all angles too many for few
    # views.
    pairs = [(k, other) for k, other in permutations(all_joints, 2) if k in moving or other in moving]
    if pairs:
        first, second = (tuple(column) for column in zip(*pairs, strict=True))
        kernels = np.array([two_joint_kernel(joints[:, k], joints[:, other]) for k, other in pairs])
        processes[TWO_ANGLES] = SmoothErrors(offsets[:, first], kernels, first, second)
    return processes | _periodic_processes(joints, offsets) | _load_processes(measurements, offsets)


def _periodic_processes(joints: Array, offsets: Array) -> dict[str, SmoothErrors]:
    """Return the process of errors that are periodic in a joint's angle, as those of gears and belts; {} if none turns.

    It has one kernel per joint and period. A joint that turned by R rad is tried with R/2, R/2.5, R/3, … as periods,
    none shorter than `_SHORTEST_PERIOD`.

    Args:
        joints: (V, n) rad.
        offsets: (6V, n) left twists of the views per unit of each joint's error.
    """
    waves = [
        (k, turned / count)
        for k, turned in enumerate(np.ptp(joints, axis=0))
        if turned > _STATIONARY_RANGE
        for count in np.arange(_MIN_WAVES, min(_MAX_WAVES, turned / _SHORTEST_PERIOD), _WAVE_STEP)
    ]
    if not waves:
        return {}
    of_joint, periods = (tuple(column) for column in zip(*waves, strict=True))
    kernels = np.array([periodic_kernel(joints[:, k], joints[:, k], period) for k, period in waves])
    return {WAVES: SmoothErrors(offsets[:, of_joint], kernels, of_joint, periods=periods)}


def _load_processes(measurements: Sequence[Measurement], offsets: Array) -> dict[str, SmoothErrors]:
    """Return the process of errors that follow the torques at each joint, one kernel per joint whose torque changes.

    {} where no torque changes, or where the sessions do not know the torques of the same joints in the same way.

    Args:
        offsets: (6V, n) left twists of the views per unit of each joint's error.
    """
    torques = [m.views.torques for m in measurements]
    first = torques[0]
    if any((of_session.names, of_session.measured) != (first.names, first.measured) for of_session in torques):
        return {}
    values = np.concatenate([of_session.values for of_session in torques])
    joint = np.array(first.joint)
    changes = np.ptp(values, axis=0) > STILL
    bent = tuple(int(k) for k in np.unique(joint[changes]))
    if not bent:
        return {}
    kernels = np.array([load_kernel(values[:, changes & (joint == k)]) for k in bent])
    return {JOINT_LOAD: SmoothErrors(offsets[:, bent], kernels, bent)}


def usual_sizes() -> dict[str, float]:
    """Return by component the variance that the errors of a usual arm have, in units of the squared plausible size.

    The components of a stop (`STOP_COMPONENTS`) are left out: the others contain them.
    """
    arm = ("joint_offset", "link_geometry", "joint_compliance", *EFFECT_FAMILY.values())
    return (
        dict.fromkeys(arm, _ARM_SCALE**2)
        | {"smooth": SMOOTH_SCALE**2}
        | dict.fromkeys(DRIFT_MEMORY, 1 / len(DRIFT_MEMORY))
    )


@dataclass(frozen=True)
class PoseErrors:
    """Errors of the poses of a rig beside white scatter: components of the covariance of the twists of all its views.

    Twists are left twists (6V,) about the centres that they were made with, session after session.
    """

    names: tuple[str, ...]
    components: Array  # (c, 6V, 6V) covariances for a variance of 1 of each component
    scales: Array  # (c,) usual σ of each
    # By effect of the library: the component that it is part of, and its columns (6V, P) at plausible sizes.
    effects: dict[str, tuple[str, Array]] = field(default_factory=dict)
    # Errors of single joints that no effect describes, by what they follow: diagnosis asks them, no component has them.
    joint_processes: dict[str, SmoothErrors] = field(default_factory=dict)
    # (2,) variances, rad² and length_unit², by which a unit of joint scatter turns and moves the flange along an axis.
    flange_per_joint: Array = field(default_factory=lambda: np.zeros(2))
    # σ that white scatter of the flange usually has, rad and length_unit; None: not known.
    scatter: tuple[float, float] | None = None

    @property
    def causes(self) -> frozenset[str]:
        """Names of all causes of pose errors: effects of the library, and components that are not made of effects."""
        of_effects = {component for component, _ in self.effects.values()}
        return frozenset(self.effects) | {name for name in self.names if name not in of_effects}

    @property
    def arm_components(self) -> Mask:
        """(c,) mask of the components that joints and links repeat: neither what wanders, nor stops, nor scatter."""
        return np.array([name not in NOT_OF_ARM for name in self.names], bool)

    @property
    def of_ordinary_arm(self) -> "PoseErrors":
        """These pose errors for an arm that errs mostly by its geometry: the scales of its other errors are reduced.

        Kept are the scales of constant offsets and links (`_CONSTANT_EFFECTS`), and of all that is no error of the arm.
        """
        beside = self.arm_components & ~np.isin(self.names, _CONSTANT_EFFECTS)
        return replace(self, scales=np.where(beside, _BESIDE_GEOMETRY, 1.0) * self.scales)

    @property
    def prior(self) -> FurtherPrior:
        """The prior of the components' sizes: every arm scatters by its joints, all else may be absent."""
        shapes = np.where(np.array(self.names) == JOINT_SCATTER, ALWAYS_PRESENT, MAY_BE_ABSENT)
        return FurtherPrior(self.scales, shapes, self.arm_components, self.scatter)

    def project(self, reduction: Array) -> "PoseErrors":
        """Return the pose errors of n numbers that are linear in the twists of the views: R C Rᵀ for each component C.

        Args:
            reduction: R (n, 6V), from twists to these numbers.
        """
        return replace(
            self,
            components=np.array([reduction @ C @ reduction.T for C in self.components]),
            effects={name: (component, reduction @ columns) for name, (component, columns) in self.effects.items()},
        )

    def restricted(self, keep: Collection[str]) -> "PoseErrors":
        """Return the pose errors of these causes alone; a component loses the effects that are not among them.

        Args:
            keep: names of effects, or of components that are not made of effects.
        """
        effects = {name: part for name, part in self.effects.items() if name in keep}
        kept, components = list[int](), list[Array]()
        for i, name in enumerate(self.names):
            all_columns = [columns for component, columns in self.effects.values() if component == name]
            kept_columns = [columns for component, columns in effects.values() if component == name]
            if kept_columns or (not all_columns and name in keep):
                kept.append(i)
                is_whole = len(kept_columns) == len(all_columns)
                # What is left is summed anew: a difference of large numbers would not be positive.
                components.append(self.components[i] if is_whole else np.sum([X @ X.T for X in kept_columns], axis=0))
        n = self.components.shape[1]
        names = tuple(self.names[i] for i in kept)
        stacked = np.array(components).reshape(-1, n, n)
        return replace(self, names=names, components=stacked, scales=self.scales[kept], effects=effects)

    def with_component(self, name: str, component: Array, scale: float) -> "PoseErrors":
        """Return these pose errors with a further component.

        Args:
            component: (6V, 6V) covariance per unit, or as `project` has reduced the others.
            scale: σ that it usually has.
        """
        components = np.concatenate([self.components, component[None]])
        return replace(self, names=(*self.names, name), components=components, scales=np.append(self.scales, scale))


def white_scatter_only(views: int) -> PoseErrors:
    """Return the pose errors of a rig of so many views that has nothing beside white scatter: no components."""
    return PoseErrors((), np.zeros((0, 6 * views, 6 * views)), np.zeros(0))


def prior_pose_errors(measurements: Sequence[Measurement], model: Model, centres: Sequence[Array]) -> PoseErrors:
    """Return the prior of pose errors for the sessions of a rig: one arm, one scanner, one mount.

    It is a sum of components, each a covariance (6V, 6V) of the twists of all views and a usual σ (see the head of this
    file). With joint angles: the families of effects, smooth errors, scatter of the joints. Always: wandering. Where
    poses repeat: what scans of one stop share. Of more than `_MOST_VIEWS` views white scatter alone.

    Args:
        model: hand-eye and effects in use, about which the effects are linearised.
        centres: per session the point (3,) about which twists count, reference frame.
    """
    if sum(m.views.count for m in measurements) > _MOST_VIEWS:
        return white_scatter_only(sum(m.views.count for m in measurements))
    # Covariance and usual σ of each component; by effect its component and its columns.
    components, effects = dict[str, tuple[Array, float]](), dict[str, tuple[str, Array]]()
    processes, flange_per_joint = dict[str, SmoothErrors](), np.zeros(2)
    # (V, V) 1 where two views are scans of one stop: they share an error that is drawn once per stop.
    shares_stop = block_diag(*(m.capture.shares_stop for m in measurements))
    if all(m.views.has("joints") for m in measurements):
        joints = np.concatenate([m.views.joints for m in measurements])
        of_arm = arm_effects(measurements)
        constant = [EFFECTS[name] for name in _CONSTANT_EFFECTS if name in EFFECTS]
        sessions = zip(measurements, centres, strict=True)
        by_session = [effect_twists(m, model, centre, [*of_arm, *constant]) for m, centre in sessions]
        twists = [np.concatenate(columns) for columns in zip(*by_session, strict=True)]
        for effect, columns in zip(of_arm, twists, strict=False):
            effects[effect.name] = (EFFECT_FAMILY.get(effect.name, effect.name), columns)
        # Effects of one family share a size.
        for family in dict.fromkeys(family for family, _ in effects.values()):
            squares = [X @ X.T for of_effect, X in effects.values() if of_effect == family]
            components[family] = (np.sum(squares, axis=0), _ARM_SCALE)
        links = np.hstack(twists[len(of_arm) :])
        joint_kernel = rbf_joints(joints)
        components["smooth"] = (process_covariance(links, joint_kernel), SMOOTH_SCALE)
        if constant[0].name == _OFFSET:
            offsets = links[:, : joints.shape[1]]
            components[JOINT_SCATTER] = (process_covariance(offsets, shares_stop), USUAL_JOINT_SCATTER)
            flange_per_joint = mean_square_per_axis(offsets, measurements, centres)
            processes = joint_processes(measurements, joints, offsets, joint_kernel)
    flange = flange_twists(measurements, centres)
    for name, memory in DRIFT_MEMORY.items():
        components[name] = (process_covariance(flange, drift_kernel(measurements, memory)), 1.0)
    same = same_stop(np.concatenate([m.T_base_flange for m in measurements]))
    if same.sum() > shares_stop.sum():
        for name, columns in zip(STOP_COMPONENTS, (flange[:, :3], flange[:, 3:]), strict=True):
            components[name] = (process_covariance(columns, same.astype(float)), 1.0)
    rotation, translation = usual_twist(measurements[0].length_unit)[[0, 3]].tolist()
    return PoseErrors(
        names=tuple(components),
        components=np.array([covariance for covariance, _ in components.values()]),
        scales=np.array([scale for _, scale in components.values()]),
        effects=effects,
        joint_processes=processes,
        flange_per_joint=flange_per_joint,
        scatter=(rotation, translation),
    )

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

import numpy as np

from stitch.effects.contract import EFFECTS
from stitch.frames import Array, Mask
from stitch.measurement.measurement import Measurement
from stitch.model.model import Model
from stitch.observations.arm_errors import (
    EFFECT_FAMILY,
    JOINT_SCATTER,
    USUAL_JOINT_SCATTER,
    arm_effects,
    effect_twists,
    group_by_family,
)
from stitch.observations.flange_errors import DRIFT_MEMORY, drift_kernel, flange_twists, mean_square_per_axis
from stitch.observations.joint_processes import joint_processes
from stitch.statistics.kernels import SmoothErrors, process_covariance, rbf_joints, same_stop
from stitch.statistics.variance_prior import ALWAYS_PRESENT, MAY_BE_ABSENT, FurtherPrior

# Scales of the half-Cauchy priors: of the arm in plausible sizes of the library's effects; what is smooth is usually
# smaller.
_ARM_SCALE, SMOOTH_SCALE = 0.1, 0.03
# What the scans of a stop share.
STOP_COMPONENTS = ("stop rotation", "stop translation")
# Dense matrices of more views take minutes; there the scatter alone must do.
_MOST_VIEWS = 150
_CONSTANT_EFFECTS = ("joint_offset", "link_geometry")


def usual_sizes() -> dict[str, float]:
    """Variances that errors of a usual arm have, by component; what repeats at one stop is part of the others."""
    arm = ("joint_offset", "link_geometry", "joint_compliance", *EFFECT_FAMILY.values())
    return (
        dict.fromkeys(arm, _ARM_SCALE**2)
        | {"smooth": SMOOTH_SCALE**2}
        | dict.fromkeys(DRIFT_MEMORY, 1 / len(DRIFT_MEMORY))
    )


@dataclass(frozen=True)
class PoseErrors:
    """Components of the covariance of the twists of all views of a rig, session after session."""

    names: tuple[str, ...]
    components: Array  # (c, 6V, 6V) per unit of each
    scales: Array  # (c,) that their σ usually has
    effects: dict[str, tuple[str, Array]] = field(default_factory=dict)  # name of its component, (6V, P) its columns
    # What each joint alone may do without a name, by what it follows: in none of the components.
    joint_processes: dict[str, SmoothErrors] = field(default_factory=dict)
    # (2,) variances, rad² and length_unit², by which a unit of joint scatter turns and moves the flange along an axis.
    flange_per_joint: Array = field(default_factory=lambda: np.zeros(2))

    @property
    def arm_components(self) -> Mask:
        """(c,) what joints and links do again: on a good arm all of it is small."""
        return np.array([name not in (*DRIFT_MEMORY, *STOP_COMPONENTS, JOINT_SCATTER) for name in self.names], bool)

    @property
    def prior(self) -> FurtherPrior:
        """What is believed of their sizes; every arm scatters by its joints, all else may be absent."""
        return FurtherPrior(
            self.scales, np.where(self._independent, ALWAYS_PRESENT, MAY_BE_ABSENT), self.arm_components
        )

    @property
    def _independent(self) -> Mask:
        """(c,) what joints do anew in every view."""
        return np.array([name == JOINT_SCATTER for name in self.names], bool)

    def project(self, reduction: Array) -> "PoseErrors":
        """The same of numbers reduction (n, 6V) @ twists."""
        return replace(
            self,
            components=np.array([reduction @ C @ reduction.T for C in self.components]),
            effects={name: (component, reduction @ own) for name, (component, own) in self.effects.items()},
        )

    def without(self, effects: Collection[str]) -> "PoseErrors":
        """What poses may err beside some effects of the library: these are asked for by name."""
        left = {name: own for name, own in self.effects.items() if name not in effects}
        keep, components = list[int](), list[Array]()
        for i, name in enumerate(self.names):
            every = [own for component, own in self.effects.values() if component == name]
            those = [own for component, own in left.values() if component == name]
            if not every or those:
                keep.append(i)
                # What is left is summed anew: a difference of large numbers would not be positive.
                untouched = len(every) == len(those)
                components.append(self.components[i] if untouched else np.sum([own @ own.T for own in those], axis=0))
        n = self.components.shape[1]
        names, kept = tuple(self.names[i] for i in keep), np.array(components).reshape(-1, n, n)
        return replace(self, names=names, components=kept, scales=self.scales[keep], effects=left)

    def without_arm(self) -> "PoseErrors":
        """What wanders in time, what scans of a stop share and what scatters; neither joints nor links err again."""
        return replace(self._select(~self.arm_components), effects={})

    def independent_only(self) -> "PoseErrors":
        """What scatters alone; nothing errs again."""
        return replace(self._select(self._independent), effects={})

    def repeating_only(self) -> "PoseErrors":
        """All but what joints do anew."""
        return self._select(~self._independent)

    def without_drift(self) -> "PoseErrors":
        """What joints and links do and what scans of a stop share; nothing wanders."""
        return self._select(np.array([name not in DRIFT_MEMORY for name in self.names], bool))

    def _select(self, keep: Mask) -> "PoseErrors":
        names = tuple(name for name, kept in zip(self.names, keep, strict=True) if kept)
        return replace(self, names=names, components=self.components[keep], scales=self.scales[keep])

    def with_component(self, name: str, component: Array, scale: float) -> "PoseErrors":
        """The same with a further component (n, n)."""
        components = np.concatenate([self.components, component[None]])
        return replace(self, names=(*self.names, name), components=components, scales=np.append(self.scales, scale))


def white_scatter_only(views: int) -> PoseErrors:
    """Nothing beside white scatter."""
    return PoseErrors((), np.zeros((0, 6 * views, 6 * views)), np.zeros(0))


def prior_pose_errors(measurements: Sequence[Measurement], model: Model, centres: Sequence[Array]) -> PoseErrors:
    """The prior for the sessions of a rig: one arm, one scanner, one mount; none for very many views.

    Args:
        model: hand-eye and effects in use; the arm errs beside these.
        centres: per session the point (3,) about which twists count, reference frame.
    """
    if sum(m.views.count for m in measurements) > _MOST_VIEWS:
        return white_scatter_only(sum(m.views.count for m in measurements))
    found, members = dict[str, tuple[Array, float]](), dict[str, tuple[str, Array]]()
    of_one_joint, by_joints = dict[str, SmoothErrors](), np.zeros(2)
    sessions = list(zip(measurements, centres, strict=True))
    if all(m.views.has("joints") for m in measurements):
        joints = np.concatenate([m.views.joints for m in measurements])
        for name, effects in group_by_family(arm_effects(measurements)).items():
            own = [np.concatenate([effect_twists(m, model, centre, [e]) for m, centre in sessions]) for e in effects]
            members |= {e.name: (name, columns) for e, columns in zip(effects, own, strict=True)}
            found[name] = (np.sum([columns @ columns.T for columns in own], axis=0), _ARM_SCALE)
        constant = [EFFECTS[name] for name in _CONSTANT_EFFECTS if name in EFFECTS]
        links = np.concatenate([effect_twists(m, model, centre, constant) for m, centre in sessions])
        alike = rbf_joints(joints)
        found["smooth"] = (process_covariance(links, alike), SMOOTH_SCALE)
        if constant[0].name == _CONSTANT_EFFECTS[0]:
            offsets = links[:, : joints.shape[1]]
            found[JOINT_SCATTER] = (process_covariance(offsets, np.eye(len(joints))), USUAL_JOINT_SCATTER)
            by_joints = mean_square_per_axis(offsets, measurements, centres)
            of_one_joint = joint_processes(measurements, joints, offsets, alike)
    flange = flange_twists(measurements, centres)
    for name, memory in DRIFT_MEMORY.items():
        found[name] = (process_covariance(flange, drift_kernel(measurements, memory)), 1.0)
    same = same_stop(np.concatenate([m.T_base_flange for m in measurements]))
    if same.sum() > len(same):
        halves = dict(zip(STOP_COMPONENTS, (flange[:, :3], flange[:, 3:]), strict=True))
        found |= {name: (process_covariance(half, same.astype(float)), 1.0) for name, half in halves.items()}
    components = np.array([c for c, _ in found.values()])
    scales = np.array([s for _, s in found.values()])
    return PoseErrors(tuple(found), components, scales, members, of_one_joint, by_joints)

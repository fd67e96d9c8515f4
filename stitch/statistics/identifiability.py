"""Which parameters the views can know: absolute first, then beside the hand-eye and each other."""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.observations.surfaces.free_poses import FreePoses
from stitch.observations.surfaces.gram import column_space
from stitch.observations.surfaces.pose_channel import covariance_of, estimate, pose_channel


def whitened(
    captures: Sequence[Capture], freed: Sequence[FreePoses], T_mount: Array, columns: Sequence[Array], values: Array,
    free: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """In units of the pose scatter, all captures stacked: columns of the hand-eye (N, 6) and of effects (N, P), z (N,).

    Args:
        values: (P,) of the effects at which the views were freed; z is what was seen without them.
        free: (P,) bool: effects that explain scatter.
    """
    out = []
    for capture, f, extra in zip(captures, freed, columns, strict=True):
        channel = pose_channel(f.overlaps.gram, f.twists, capture.hand_eye_frames(T_mount), capture.T_reference_flange)
        further = channel.reduction @ extra
        half = np.linalg.cholesky(covariance_of(channel, estimate(channel, further[:, free])))
        stack = np.column_stack([channel.hand_eye, further, channel.z + further @ values])
        out.append(np.linalg.solve(half, stack))
    everything = np.concatenate(out)
    return everything[:, :6], everything[:, 6:-1], everything[:, -1]


def independent(base: Array, further: Array, sizes: Array, threshold: float) -> Array:
    """(P,) bool: columns that stand out by at least `threshold` sigmas at their size, beside those chosen before.

    The clearest is chosen first (QR with pivoting), so that of two that say the same the better known stays.

    Args:
        base: (N, a) whitened columns that come first, whatever they say.
        further: (N, P) whitened columns per unit of their parameters.
        sizes: (P,) plausible sizes of the parameters.
    """
    rest = project_out(base, further * sizes)
    chosen = np.zeros(further.shape[1], bool)
    while True:
        strength = np.where(chosen, 0.0, np.linalg.norm(rest, axis=0))
        if not len(strength) or strength.max() < threshold:
            return chosen
        best = int(strength.argmax())
        chosen[best] = True
        direction = rest[:, best] / strength[best]
        rest = rest - np.outer(direction, direction @ rest)


def project_out(base: Array, columns: Array) -> Array:
    """What is left of `columns` beside the column space of `base`."""
    if not base.shape[1]:
        return columns
    U = column_space(base)
    return np.asarray(columns - U @ (U.T @ columns))

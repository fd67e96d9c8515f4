"""A serial robot whose links are a little wrong: where its flange truly is, and how that answers to every error."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.robot import Robot, elementary

_X, _Z = 0, 2  # columns of a frame


@dataclass(frozen=True)
class Links:
    """What is wrong with an arm's links: a factor on all lengths per view, and errors of the DH rows.

    For URDF the errors act behind the joint in the frame that its axis makes: along x, along z, about x.
    """

    scale: Array  # (V,)
    da: Array  # (n,) length_unit
    dd: Array  # (n,) length_unit
    dalpha: Array  # (n,) rad


@dataclass(frozen=True)
class FlangeSlopes:
    """Body twists of the flange, T·exp(slope·error), rotation first, per unit of each error."""

    joints: Array  # (V, 6, n)
    scale: Array  # (V, 6)
    da: Array  # (V, 6, n)
    dd: Array  # (V, 6, n)
    dalpha: Array  # (V, 6, n)

    def twists(self, joints: Array, links: Links) -> Array:
        """(V, 6) of the flange for small changes of the joint angles (V, n) and of the links."""
        rows = np.einsum("vki,i->vk", self.da, links.da) + np.einsum("vki,i->vk", self.dd, links.dd)
        rows += np.einsum("vki,i->vk", self.dalpha, links.dalpha)
        return np.asarray(np.einsum("vki,vi->vk", self.joints, joints) + self.scale * links.scale[:, None] + rows)


def exact_links(count: int, joints: int) -> Links:
    """Those of an arm without any error, for `count` views."""
    return Links(np.ones(count), *np.zeros((3, joints)))


def forward_with_errors(robot: Robot, joints: Array, links: Links) -> Array:
    """T_base_flange (V, 4, 4) of an arm with such links, for joint angles (V, n) in rad."""
    return np.asarray(_chain(robot, joints, links)[-1][2])


def flange_slopes(robot: Robot, joints: Array, links: Links) -> FlangeSlopes:
    """How the flange answers to small changes of joint angles (V, n) and links, about these.

    Each error is a screw in a frame of the chain, seen from the flange (Lynch & Park, *Modern Robotics*, 5.1.2).
    """
    chain = _chain(robot, joints, links)
    T, modified = chain[-1][2], robot.convention == "modified"
    still, slopes = np.zeros((len(joints), 3)), dict[str, list[Array]](joints=[], da=[], dd=[], dalpha=[])
    scale, reach = np.zeros((len(joints), 6)), links.scale[:, None]
    for before, turned, after, moved in chain:
        row = before if modified else after  # the frame at whose x axis da and dalpha act
        slopes["joints"].append(_screw(T, turned, turned[..., :3, _Z], still))
        slopes["da"].append(_screw(T, row, still, reach * row[..., :3, _X]))
        slopes["dalpha"].append(_screw(T, row, row[..., :3, _X], still))
        # d lies along the joint's own axis: ahead of `after`, or, modified, at its end.
        slopes["dd"].append(_screw(T, after, still, reach * (after if modified else turned)[..., :3, _Z]))
        scale += _screw(T, after, still, moved / reach)
    stacked = {name: np.stack(own, axis=-1) for name, own in slopes.items()}
    return FlangeSlopes(scale=scale, **stacked)


def _chain(robot: Robot, joints: Array, links: Links) -> list[tuple[Array, Array, Array, Array]]:
    """Per joint the frames T_base_· (V, 4, 4) before its turn, after it and at the link's end, and (V, 3) by how much
    the link's lengths move that end."""
    modified = robot.convention == "modified"
    x_error, z_error = elementary("x", links.dalpha, links.da), elementary("z", 0, links.dd)
    T, out = np.broadcast_to(np.eye(4), (len(joints), 4, 4)), []
    for i in range(robot.n_joints):
        if modified:
            own = robot.before[i] @ x_error[i], robot.after[i] @ z_error[i]
        else:
            own = robot.before[i], z_error[i] @ robot.after[i] @ x_error[i]
        before, after = (_scaled(factor, links.scale) for factor in own)
        first = T @ before
        turned = first @ elementary("z", joints[:, i] + robot.theta[i])
        last = turned @ after
        moved = first[:, :3, 3] - T[:, :3, 3] + last[:, :3, 3] - turned[:, :3, 3]
        out.append((first, turned, last, moved))
        T = last
    return out


def _scaled(T: Array, scale: Array) -> Array:
    """(V, 4, 4) of one transform, its lengths times `scale` (V,)."""
    out = np.tile(T, (len(scale), 1, 1))
    out[:, :3, 3] *= scale[:, None]
    return out


def _screw(T_base_flange: Array, at: Array, turn: Array, shift: Array) -> Array:
    """(V, 6) body twist of the flange of a turn and a shift (V, 3) in the base's directions at the origin of `at`."""
    lever = T_base_flange[:, :3, 3] - at[:, :3, 3]
    back = frames.inverse(T_base_flange)
    moved = (turn, np.cross(turn, lever) + shift)
    return np.concatenate([frames.rotate(back, part[:, None])[:, 0] for part in moved], axis=1)

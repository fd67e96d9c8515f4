import numpy as np

from stitch.effects import effect, per_joint


@effect("robot", needs=("joints",), A=per_joint("rad", 2e-4, 0.01), B=per_joint("rad", 2e-4, 0.01))
def third_harmonic(joints, views, A, B):
    """q* = q + A·sin 3q + B·cos 3q"""
    return joints + A * np.sin(3 * views.joints) + B * np.cos(3 * views.joints)

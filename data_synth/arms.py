"""Robot arms as standard DH rows with masses and joint limits.

Lengths and limits are those of the makers' data sheets. Only the UR10's masses and centres of mass are
published; those of the others are estimates that add up to the catalogue's weight. Signs and zeros are
DH's, not the controllers'.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Arm:
    """n revolute joints; lengths in mm, angles in rad, masses in kg, centres of mass in the link's DH frame."""

    name: str
    a: Array
    alpha: Array
    d: Array
    theta: Array  # offset of the joint angle
    mass: Array
    com: Array  # (n, 3)
    lower: Array
    upper: Array
    home: Array  # a pose from which inverse kinematics starts
    payload_mass: float = 0.0
    payload_com: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the flange frame

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.a)


def _arm(name: str, rows: str, home: str) -> Arm:
    """Rows of: a alpha_deg d theta_deg | mass com_x com_y com_z | lower_deg upper_deg."""
    table = np.array([[float(x) for x in line.replace("|", " ").split()] for line in rows.strip().splitlines()])
    a, alpha, d, theta, mass, cx, cy, cz, lower, upper = table.T
    return Arm(
        name=name,
        a=a,
        alpha=np.radians(alpha),
        d=d,
        theta=np.radians(theta),
        mass=mass,
        com=np.column_stack([cx, cy, cz]),
        lower=np.radians(lower),
        upper=np.radians(upper),
        home=np.radians([float(x) for x in home.split()]),
    )


ARMS: dict[str, Arm] = {
    arm.name: arm
    for arm in (
        _arm(
            "KUKA KR30-3",
            """350 -90 815   0 | 200 -200  120    0 | -185 185
               850   0   0   0 | 150 -480    0 -120 | -135  35
               145 -90   0 -90 | 110  -70  -20   20 | -120 158
                 0  90 820   0 |  55    0 -330    0 | -350 350
                 0 -90   0   0 |  22    0    0   40 | -119 119
                 0   0 170   0 |   5    0    0  -40 | -350 350""",
            "0 -80 70 0 60 0",
        ),
        _arm(
            "ABB IRB 120",
            """  0 -90 290   0 | 3.1    0   54    0 | -165 165
               270   0   0 -90 | 3.9 -169    0    0 | -110 110
                70 -90   0   0 | 2.9  -12    1  -19 | -110  70
                 0  90 302   0 | 1.3    0 -124    0 | -160 160
                 0 -90   0   0 | 0.6    0    0    0 | -120 120
                 0   0  72   0 | 0.2    0    0  -10 | -400 400""",
            "0 10 10 0 60 0",
        ),
        _arm(
            "UR10",
            """   0   90 127.3   0 | 7.1   21    0   27 | -360 360
               -612    0     0   0 | 12.7 380   0  158 | -360 360
             -572.3    0     0   0 | 4.27 240   0   68 | -360 360
                  0   90 163.941 0 | 2.0    0   7   18 | -360 360
                  0  -90 115.7   0 | 2.0    0   7   18 | -360 360
                  0    0  92.2   0 | 0.365  0   0  -26 | -360 360""",
            "0 -70 110 -130 -90 0",
        ),
        _arm(
            "KUKA LBR iiwa 14",
            """0 -90 360 0 | 6.4 0  -60 -30 | -170 170
               0  90   0 0 | 7.9 0   60 -40 | -120 120
               0  90 420 0 | 3.4 0   70  30 | -170 170
               0 -90   0 0 | 3.5 0  -60  30 | -120 120
               0 -90 400 0 | 3.5 0  -70  20 | -170 170
               0  90   0 0 | 4.7 0    0  20 | -120 120
               0   0 152 0 | 0.5 0    0 -30 | -175 175""",
            "0 30 0 -80 0 60 0",
        ),
    )
}


def with_payload(arm: Arm, mass: float, com: tuple[float, float, float]) -> Arm:
    """The arm that carries `mass` kg with its centre at `com` mm in the flange frame."""
    return replace(arm, payload_mass=mass, payload_com=com)

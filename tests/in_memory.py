"""A simulated session as the reader would give it, without files."""

from pathlib import Path

import numpy as np

from data_synth.simulate import Measured
from data_synth.write import robot_table
from stitch.measurement.cloud import Cloud
from stitch.measurement.session import Scanner, Session, View
from stitch.reading.dh_rows import robot_from_dh


def session_of(measured: Measured) -> Session:
    """The session that `write_session` and `load_session` would make of it."""
    scene = measured.scene
    robot = None
    if not scene.rail:
        table = robot_table(scene.arm)
        robot = robot_from_dh(
            scene.arm.name, "standard", table["joints"], table.get("payload"), np.array(table["gravity"]), "mm"
        )
    views = tuple(
        View(
            f"v{v:03d}", Cloud(cloud.points, None, {"intensity": cloud.intensity}), measured.T_base_flange[v],
            measured.plan.joints[v] if robot else None, measured.approach[v] if robot else None,
            float(measured.times[v]), {name: float(values[v]) for name, values in measured.covariates.items()},
        )
        for v, cloud in enumerate(measured.clouds)
    )  # fmt: skip
    scanner = Scanner(measured.T_coarse, scene.scanner.noise, scene.scanner.standoff, np.array([0.0, 0.0, 1.0]))
    return Session(Path(scene.name), scene.name, "mm", scene.mount, scanner, robot, None, None, None, views)

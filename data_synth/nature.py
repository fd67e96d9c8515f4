"""What really happens in a cell: physical effects forwards, each at its place of the chain.

A law turns what the controller believes into what is: true joint angles bend, the scanner grows warm,
the part sags. Laws know nothing of how a model would correct them; `stitch.effects` knows nothing of them.

Every law has a size at amplitude 1 that a cell could really have: around a tenth of a millimetre at the
part. The last two have no counterpart in any library of effects.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.laws import bodies, brackets, joints, points
from data_synth.moment import Moment

Array = NDArray[np.float64]
Parameters = dict[str, float]
# Always there, each far below what twenty views can show.
SMALL = {"joint_compliance": 0.04, "gear_harmonic": 0.04, "mount_drift": 0.04, "incidence_bias": 0.05}


@dataclass(frozen=True)
class Law:
    """One effect of nature. `place` says which function of the chain it changes."""

    place: str  # base | joints | arm | mount | part | surface | points
    draw: Callable[[float, Any, np.random.Generator], Parameters]  # (amplitude, plan, rng) → parameters
    act: Callable[..., Any]  # (parameters, moment, value) → value


LAWS: dict[str, Law] = {
    "range_scale": Law("points", points.draw("s", 5e-4), points.range_scale),
    "range_nonlinearity": Law("points", points.draw("k", 3.0), points.range_nonlinearity),
    "incidence_bias": Law("points", points.draw("b", 0.05), points.incidence_bias),
    "intensity_bias": Law("points", points.draw("k", 0.03), points.intensity_bias),
    "field_curvature": Law("points", points.draw("k", 2.0), points.field_curvature),
    "lens_distortion": Law("points", points.draw("k1", 0.02), points.lens_distortion),
    "scanner_thermal_scale": Law("points", points.draw("k", 1.5e-4), points.scanner_thermal_scale),
    "latency": Law("joints", points.draw("dt", 2e-3), joints.latency),
    "mount_drift": Law("mount", bodies.draw_twist(4e-4, 0.15), bodies.mount_drift),
    "mount_warmup": Law("mount", bodies.draw_warmup, bodies.mount_warmup),
    "joint_offset": Law("joints", joints.draw_one("d", 3e-4, sign=True), joints.joint_offset),
    "link_geometry": Law("arm", joints.draw_link, joints.link_geometry),
    "joint_compliance": Law("joints", joints.draw_compliance, joints.joint_compliance),
    "gear_eccentricity": Law("joints", joints.draw_wave(3e-4), joints.wave(1)),
    "gear_harmonic": Law("joints", joints.draw_wave(2e-4), joints.wave(2)),
    "backlash": Law("joints", joints.draw_one("b", 2e-4), joints.backlash),
    "settling": Law("joints", joints.draw_all("s", 4e-4), joints.settling),
    "robot_thermal_growth": Law("arm", points.draw("g", 2e-5), joints.robot_thermal_growth),
    "fixture_drift": Law("part", bodies.draw_twist(6e-4, 0.15), bodies.fixture_drift),
    "part_growth": Law("surface", points.draw("g", 2.3e-5), bodies.part_growth),
    "part_sag": Law("surface", points.draw("kappa", 3e-6), bodies.part_sag),
    "part_slip": Law("part", bodies.draw_slip(4e-4, 0.1), bodies.part_slip),
    "mount_droop": Law("mount", brackets.draw, brackets.mount_droop),
    "fixture_droop": Law("part", brackets.draw, brackets.fixture_droop),
    "base_compliance": Law("base", bodies.draw_base, bodies.base_compliance),
    "joint_thermal": Law("joints", joints.draw_thermal, joints.joint_thermal),
    "link_thermal": Law("arm", joints.draw_warm_link, joints.link_thermal),
    "joint_step": Law("joints", joints.draw_step, joints.joint_step),
    "mount_creep": Law("mount", bodies.draw_creep, bodies.mount_creep),
    "mount_step": Law("mount", bodies.draw_slip(4e-4, 0.1), bodies.mount_step),
    "mount_bend": Law("mount", brackets.draw_oblique, brackets.mount_droop),
    "fixture_bend": Law("part", brackets.draw_oblique, brackets.fixture_droop),
    "third_harmonic": Law("joints", joints.draw_wave(2.5e-4), joints.wave(3)),
    "covariate_bias": Law("points", points.draw("k", 0.012), points.covariate_bias),
}


@dataclass(frozen=True)
class Nature:
    """The laws at work in one cell with their parameters, in the order of the chain."""

    laws: tuple[tuple[str, Parameters], ...]

    def act(self, place: str, moment: Moment, value: Any) -> Any:
        """Apply all laws of one place to what the controller believes."""
        for name, parameters in self.laws:
            if LAWS[name].place == place:
                value = LAWS[name].act(parameters, moment, value)
        return value

    def without(self, name: str) -> "Nature":
        """All laws but one."""
        return Nature(tuple(law for law in self.laws if law[0] != name))

    def touches(self, place: str) -> bool:
        """True if a law works there."""
        return any(LAWS[name].place == place for name, _ in self.laws)


def draw(
    hidden: dict[str, float], small: float, plan: Any, rng: np.random.Generator
) -> tuple[Nature, dict[str, Parameters]]:
    """Parameters of the hidden laws and of the small ones; the second value holds the hidden for the truth.

    Raises ValueError for an unknown law.
    """
    for name in hidden:
        if name not in LAWS:
            raise ValueError(f"nature knows no {name!r}; it knows {', '.join(LAWS)}")
    told = {name: LAWS[name].draw(size, plan, rng) for name, size in hidden.items()}
    # A hidden law takes the place of its quiet one: what the truth tells of it is then all there is.
    quiet = [
        (name, LAWS[name].draw(size * small, plan, rng)) for name, size in SMALL.items() if small and name not in told
    ]
    return Nature((*told.items(), *quiet)), told

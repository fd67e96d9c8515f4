"""Effects and covariates in the words of the shop floor; the formula of an effect stands in its docstring."""

import re

from stitch.numerics.units import covariate_text

DESCRIPTIONS = {
    "base_compliance": "the robot's base tilts under arm and load",
    "latency": "scan and pose are not taken at the same time",
    "joint_offset": "a joint counts its angle from a wrong zero",
    "link_geometry": "the arm's links are not as long or as square as stated",
    "joint_compliance": "joints give way under load",
    "gear_eccentricity": "a gear runs out of true, once a turn",
    "gear_harmonic": "a gear runs out of true, twice a turn",
    "backlash": "a joint has play",
    "settling": "the arm is measured before it has come to rest",
    "robot_thermal_growth": "the arm grows with its warmth",
    "joint_thermal": "joints turn with a temperature",
    "link_thermal": "links of the arm grow with a temperature",
    "joint_step": "a joint lost counts between two views",
    "mount_drift": "the scanner's mount drifts",
    "mount_warmup": "the scanner's mount moves while it warms up",
    "mount_creep": "the scanner's mount settles, fast at first and ever slower",
    "mount_step": "the scanner moved on its mount between two views",
    "mount_droop": "the scanner's mount gives way under its weight",
    "mount_bend": "the scanner's oblique bracket gives way under its weight",
    "fixture_drift": "the part's fixture drifts",
    "fixture_droop": "the part's fixture gives way under its weight",
    "fixture_bend": "the part's oblique fixture gives way under its weight",
    "part_slip": "the part slipped between two views",
    "part_growth": "the part grows with its warmth",
    "part_sag": "the part bends under its own weight",
    "range_scale": "the scanner measures all distances too long or too short by one factor",
    "range_nonlinearity": "the scanner errs nearer or farther than its working distance",
    "incidence_bias": "the scanner is off where it looks along the surface",
    "intensity_bias": "the scanner is off on dark or shiny places",
    "field_curvature": "the scanner sees a flat surface bent",
    "lens_distortion": "the scanner's lens distorts",
    "scanner_thermal_scale": "the scanner's scale changes with its warmth",
    "axis_eccentricity": "a table runs out of true sideways, once a turn",
    "axis_wobble": "a table wobbles, once a turn",
    "axis_scale": "a rail counts its way too long or too short",
    "axis_pitch": "a rail's carriage tips or yaws along its way",
    "axis_backlash": "an external axis has play",
}
# What ends an effect at the machine; the scans at hand are saved by adding it to the model.
REMEDIES = {
    "base_compliance": "tighten the bolts of the robot's base and stiffen what it stands on",
    "latency": "stop the arm for every scan, or trigger both together",
    "joint_offset": "set the zero of the joint anew, or write the corrected arm back into the controller",
    "link_geometry": "write the corrected arm back into the controller",
    "joint_compliance": "state the payload in the controller, or keep the effect in the model",
    "gear_eccentricity": "have the joint's gear checked at the next service; until then keep the effect in the model",
    "gear_harmonic": "have the joint's gear checked at the next service; until then keep the effect in the model",
    "backlash": "approach every pose from the same side, or have the joint's gear adjusted",
    "settling": "wait longer at each pose before the scan",
    "robot_thermal_growth": "warm the arm up before scanning",
    "joint_thermal": "warm the arm up before scanning, and keep that temperature",
    "link_thermal": "warm the arm up before scanning, and keep that temperature",
    "joint_step": "set the zero of the joint anew, and have its encoder and belt checked",
    "mount_drift": "fasten the scanner's mount",
    "mount_warmup": "let the scanner warm up before scanning",
    "mount_creep": "mount the scanner some hours before scanning, and tighten its screws again",
    "mount_step": "fasten the scanner's mount, and scan with one tool from the first view to the last",
    "mount_droop": "stiffen the scanner's mount",
    "mount_bend": "stiffen the scanner's mount, or hold it along the flange's axis",
    "fixture_drift": "fasten the part's fixture",
    "fixture_droop": "stiffen the part's fixture",
    "fixture_bend": "stiffen the part's fixture, or hold the part along the flange's axis",
    "part_slip": "clamp the part firmly",
    "part_growth": "let the part reach the temperature of the room",
    "part_sag": "support the part where it bends",
    "range_scale": "have the scanner calibrated",
    "range_nonlinearity": "scan at the working distance, or have the scanner calibrated",
    "incidence_bias": "look at every surface more squarely",
    "intensity_bias": "coat dark and shiny places",
    "field_curvature": "have the scanner calibrated, or use the middle of its field",
    "lens_distortion": "have the scanner calibrated, or use the middle of its field",
    "scanner_thermal_scale": "let the scanner warm up before scanning",
    "axis_eccentricity": "have the table's bearing checked; until then keep the effect in the model",
    "axis_wobble": "have the table's bearing checked; until then keep the effect in the model",
    "axis_scale": "have the rail measured, or write its scale into the controller",
    "axis_pitch": "have the rail aligned; until then keep the effect in the model",
    "axis_backlash": "approach every reading from the same side",
}
# The same of one joint.
JOINT_DESCRIPTIONS = {
    "joint_offset": "counts its angle from a wrong zero",
    "joint_compliance": "gives way under load",
    "gear_eccentricity": "has a gear that runs out of true once a turn",
    "gear_harmonic": "has a gear that runs out of true twice a turn",
    "backlash": "has play",
    "settling": "is measured before it has come to rest",
    "joint_thermal": "turns with a temperature",
    "joint_step": "lost counts",
}
# What began at a view that is known.
EVENTS = {
    "part_slip": "the part slipped",
    "mount_step": "the scanner moved on its mount",
    "joint_step": "a joint lost counts",
}


def effect_description(name: str) -> str:
    """Return an effect in a few words; empty for a user's own."""
    return DESCRIPTIONS.get(name, "")


def effect_in_words(name: str) -> str:
    """Return an effect's name with a description; the name alone for a user's own."""
    return f"{name} ({DESCRIPTIONS[name]})" if name in DESCRIPTIONS else name


def plain_covariate(name: str) -> str:
    """Return a covariate in words without its unit: j2_deg is the angle of joint 2."""
    joint = re.fullmatch(r"j(\d+)_deg", name)
    return f"the angle of joint {joint[1]}" if joint else covariate_text(name).partition(" (")[0]

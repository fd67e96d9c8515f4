"""What every effect of the library is on the shop floor, in a few words; the formula stands in its docstring."""

_WORDS = {
    "latency": "scan and pose are not taken at the same time",
    "joint_offset": "a joint counts its angle from a wrong zero",
    "link_geometry": "the arm's links are not as long or as square as stated",
    "joint_compliance": "joints give way under load",
    "gear_eccentricity": "a gear runs out of true, once a turn",
    "gear_harmonic": "a gear runs out of true, twice a turn",
    "backlash": "a joint has play",
    "settling": "the arm is measured before it has come to rest",
    "robot_thermal_growth": "the arm grows with its warmth",
    "mount_drift": "the scanner's mount creeps",
    "mount_warmup": "the scanner's mount moves while it warms up",
    "fixture_drift": "the part's fixture creeps",
    "part_slip": "the part slipped between two views",
    "part_growth": "the part grows with its warmth",
    "part_sag": "the part bends under its own weight",
    "range_scale": "the scanner measures all distances too long or too short by one factor",
    "range_nonlinearity": "the scanner is off away from its working distance",
    "incidence_bias": "the scanner is off where it looks along the surface",
    "intensity_bias": "the scanner is off on dark or shiny places",
    "field_curvature": "the scanner sees a flat surface bent",
    "lens_distortion": "the scanner's lens distorts",
    "scanner_thermal_scale": "the scanner's scale changes with its warmth",
}


def effect_description(name: str) -> str:
    """An effect in a few words; nothing of one of one's own."""
    return _WORDS.get(name, "")


def effect_in_words(name: str) -> str:
    """An effect's name with what it is; of an effect of one's own the name alone."""
    return f"{name} ({effect_description(name)})" if effect_description(name) else name

"""What may be wrong in a hand-eye, in words.

The keys are the sources of its variance: white scatter (`error_model.py`), what poses may err beside it
(`pose_errors.py`), and what every view repeats (`surface_step.py`) or none shows (`hand_eye.py`).
"""

ANOTHER_ARM = "another run's arm"

SOURCES = {
    "white rotation": "poses that turn at random",
    "white translation": "poses that scatter at random",
    "sensor noise": "the sensor's noise",
    "joint_offset": "joints that count from a wrong zero",
    "link_geometry": "links of another length than stated",
    "joint_compliance": "joints that give way under load",
    "gears": "gears that do not turn evenly",
    "play": "play in the joints",
    "joint scatter": "joints that scatter at random",
    "smooth": "errors that follow the joint angles by no law",
    "quickly wandering": "poses that wander, and forget it within a few views",
    "slowly wandering": "poses that wander slowly all session long",
    "stop rotation": "turns of the flange that all scans from one pose share",
    "stop translation": "shifts of the flange that all scans from one pose share",
    "scanner field": "errors of the scanner that every view repeats",
    ANOTHER_ARM: "the arm of another run",
    "unseen": "directions that these views do not show",
}


def unfitted(effect: str) -> str:
    """What an effect in use may do by parameters that stay at zero, as a source and in words."""
    return f"numbers of {effect} that stay at zero, since these views hardly tell them from the hand-eye"

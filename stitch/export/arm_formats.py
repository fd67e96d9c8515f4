"""The calibrated arm as DH rows and as URDF, with the effects that such tables can hold."""

from stitch.calibrate.robot_calibration import CalibratedRobot, beyond_sentence, calibrated_robot
from stitch.calibrate.robot_table import robot_toml
from stitch.errors import InputError
from stitch.export.arm_model import ArmModel
from stitch.export.text_lines import xml_comment
from stitch.writing.urdf_file import to_urdf


def arm_dh(arm: ArmModel) -> str:
    """The [robot] table of session.toml: DH rows in the session's length_unit and degrees.

    Raises:
        InputError: an arm that came as URDF has no DH rows.
    """
    found = calibrated_robot(arm.robot, arm.terms)
    table = robot_toml(found.robot, ["The [robot] table of session.toml", *_comment_lines(found)])
    if table is None:
        raise InputError(f"the arm of session {arm.session} is stated as URDF and has no DH rows; use --to arm-urdf")
    return table


def arm_urdf(arm: ArmModel) -> str:
    """URDF in m and rad: base_link, link_1 … link_n, flange."""
    found = calibrated_robot(arm.robot, arm.terms)
    declaration, chain = to_urdf(found.robot).split("\n", 1)
    return f"{declaration}\n{xml_comment([f'The arm of session {arm.session}', *_comment_lines(found)])}{chain}\n"


def _comment_lines(calibrated: CalibratedRobot) -> list[str]:
    """What is in it, what is not, and which command fits a table that stands alone."""
    told = ["with the joint offsets and link errors that the model of the run has.", beyond_sentence(calibrated)]
    if not calibrated.beyond:
        return told
    return [
        *told,
        "Without it this may leave more than the nominal arm; stitch calibrate robot fits a table for itself.",
    ]


ARM_FORMATS = {"arm-dh": arm_dh, "arm-urdf": arm_urdf}

"""Laws without a name as rivals of names: of some joint, or of the flange in time."""

from stitch.diagnosis.unknown import joint_laws, time_laws
from stitch.observations.linear_model import LinearModel


def unnamed_law_log_posterior(base: LinearModel) -> float:
    """Of the likelier, as those of effects in the same model (`Ranked`); −∞ where there is none."""
    return max(joint_laws.joint_law_log_posterior(base), time_laws.time_law_log_posterior(base))

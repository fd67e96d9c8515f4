"""The regimes of a diagnosis: everything that depends on the number of views or on a prior of pose errors.

With fewer than 100 views of scans, the covariance holds all that poses may do wrong again, as random effects whose
sizes the views tell (`pose_errors.py`), and each effect is asked beside all of that. Scoring every candidate so takes
about a minute for 100 views and grows with the cube of their number. From 100 views on, and with labelled points, poses
count as scattering independently. Many views tell several effects apart at once; few views do not.
"""

from dataclasses import dataclass

from stitch.diagnosis import thresholds as limits
from stitch.numerics.parameter_selection import ANY_SIZE, PLAUSIBLE
from stitch.numerics.reml import MANY_NUMBERS
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import MANY_VIEWS


@dataclass(frozen=True)
class Regime:
    """How a session is diagnosed, and what follows from that."""

    prior: bool  # pose errors have a prior: each effect is asked beside all that poses may do wrong again
    many_views: bool  # several effects are selected at once, and one that others make idle is dropped
    numbers: int  # in the channel

    @property
    def scales(self) -> dict[float, float]:
        """Multiples of an effect's plausible sizes, with their shares: beside a prior of pose errors any size may be
        the true one; without it labelled points and many views show sizes whatever their prior."""
        return ANY_SIZE if self.prior else PLAUSIBLE

    @property
    def long_without_prior(self) -> bool:
        """So many numbers that the variances are known to as many degrees of freedom, and one scale is enough."""
        return not self.prior and self.numbers > limits.LONG

    @property
    def free_fit_keeps_variances(self) -> bool:
        """The free fit takes the variances of the fit with plausible sizes: they are the same, or many and slow."""
        return self.prior or self.numbers > limits.LONG

    @property
    def least_quick_gain(self) -> float:
        """Nats at the null's variances below which a form is not worth a fit of its own."""
        return limits.HOPELESS_GAIN_WITH_PRIOR if self.prior else limits.HOPELESS_GAIN

    @property
    def forms_refitted(self) -> int:
        """Forms of a candidate that are worth a fit of their own."""
        if self.prior and self.numbers > limits.LONG:
            return 1
        return (
            limits.FORMS_REFITTED_WITH_MANY_NUMBERS
            if self.numbers > MANY_NUMBERS
            else limits.REFITTED_NUMBERS // self.numbers
        )


def regime_of(linear: LinearModel) -> Regime:
    """Return how a session is diagnosed: the one switch between few views, many views and labelled points."""
    return Regime(linear.pose_errors is not None, linear.measurement.views.count >= MANY_VIEWS, linear.mixed.size)

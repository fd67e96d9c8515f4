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
    """How a session is diagnosed."""

    prior: bool  # pose errors have a prior: each effect is asked beside all that poses may do wrong again
    many_views: bool  # several effects are selected at once, and one that others make idle is dropped
    # Multiples of an effect's plausible sizes, with their shares: beside a prior of pose errors any size may be the
    # true one; without it labelled points and many views show sizes whatever their prior.
    scales: dict[float, float]
    # No prior, and so many observations that the variances are known to as many degrees of freedom: the likeliest of
    # the scales is enough.
    one_scale_is_enough: bool
    # The free fit takes the variances of the fit with plausible sizes: they are the same, or many and slow.
    free_fit_keeps_variances: bool
    # A form is one choice of an effect's parameters (`candidates.Form`); one that is likely at the variances of the
    # null hypothesis is fitted with variances of its own.
    least_quick_gain: float  # log Bayes factor at the null's variances below which a form is not worth that
    forms_refitted: int  # of a candidate, at the most


def regime_of(linear: LinearModel) -> Regime:
    """Return how a session is diagnosed: few views of clouds, many views, or labelled points.

    Three facts decide: whether pose errors have a prior, as with fewer than 100 views of clouds, the number of views,
    and that of reduced observations. The last says how well variances are known, and how long a fit takes.
    """
    prior = linear.pose_errors is not None
    observations = linear.mixed.size
    settled = observations > limits.SETTLED_VARIANCES
    if prior and settled:
        # With many variances beside many observations each fit takes long: the likeliest form alone.
        forms_refitted = 1
    elif observations > MANY_NUMBERS:
        forms_refitted = limits.FORMS_REFITTED_WITH_MANY_NUMBERS
    else:
        forms_refitted = limits.REFITTED_NUMBERS // observations
    return Regime(
        prior=prior,
        many_views=linear.measurement.views.count >= MANY_VIEWS,
        scales=ANY_SIZE if prior else PLAUSIBLE,
        one_scale_is_enough=settled and not prior,
        free_fit_keeps_variances=settled or prior,
        least_quick_gain=limits.HOPELESS_GAIN_WITH_PRIOR if prior else limits.HOPELESS_GAIN,
        forms_refitted=forms_refitted,
    )

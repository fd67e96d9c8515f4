"""Every threshold that decides what a diagnosis says: its meaning, its unit and where its value comes from."""

import numpy as np

# Family-wise error over all candidates (5 %, custom), shared between names and the alarm without one.
ALPHA = 0.05
ALPHA_NAME, ALPHA_UNKNOWN = 0.8 * ALPHA, 0.2 * ALPHA
# Log Bayes factor over "nothing is missing" that an alarm needs: 12 to 1, "positive" to "strong" (Kass & Raftery 1995).
LOG_BAYES_FACTOR = 2.5
# A name needs 20 to 1 over every other, and the unknown 20 to 1 over every name ("strong", Kass & Raftery 1995).
ODDS = float(np.log(20.0))
# Prior shares: nothing is missing, one effect of the library, something without a name (of every kind by itself).
PRIOR_NOTHING, PRIOR_PHYSICAL, PRIOR_UNKNOWN = 0.5, 0.45, 0.05
# Probability with which the smallest detectable size is detected (custom in power analysis).
POWER = 0.8

# Beyond so many, columns of candidates take a megabyte each, and all of them half a gigabyte.
MANY_POSES = 1000
# Effects that are sought at once, and candidates tried in earnest for each of them: what a minute allows.
MAX_JOINT_EFFECTS, CANDIDATES_TRIED = 6, 5

# No arm that is fit for use scatters more than this (rad, mm): several times the repeatability of data sheets
# (ISO 9283, 0.02 to 0.1 mm); larger is something systematic.
IMPLAUSIBLE = (2.5e-4, 0.12)
# Smallest share of an effect that must remain when one view is left out.
MIN_STEADINESS = 0.25
# A p-value below which two halves of the views do not find one and the same: one right effect of a hundred is lost.
HALVES_P_VALUE = 0.01
# An effect must shorten the distances on views left out by more than a hundredth to stay in a model (mean square).
MAX_REMAINING_SHARE = 0.99**2
# New matches alone change a held-out residual by a few per cent: it rises if it does by more, and falls if below.
HELDOUT_RISE, HELDOUT_FALL = 1.05, 0.995
# An effect so many sigmas from zero is there although no residual shows it; below the second it can be dropped.
CLEAR_SIGMAS, FAINT_SIGMAS = 4.0, 2.0

# Effects whose patterns correlate more than this are aliases in these views.
ALIAS_CORRELATION = 0.9
# λ with P(correct) = Φ(√(λ/2)) = 0.95 between two effects.
SEPARATION_LAMBDA = 5.4
# p-value below which what is left is said to follow a covariate (custom).
CLEAR_DEPENDENCE = 0.01
# Candidates whose prediction on left-out views is computed; the others explain nothing.
CROSS_VALIDATED_CANDIDATES = 8

# Numbers in the channel beyond which variances are the same under both priors of sizes, and a fit takes half a second.
LONG = 250
# Nats: forms that lose so many under the null's variances do not gain under their own either; under several variances,
# of which one is nearly that of the maximum, they gain half a nat at the most.
HOPELESS_GAIN, HOPELESS_GAIN_WITH_PRIOR = -4.0, -1.5
# Numbers times forms that are fitted for a candidate (some seconds). With thousands of numbers the variances hardly
# move, and each fit takes a second: the best forms must do.
REFITTED_NUMBERS, FORMS_REFITTED_WITH_MANY_NUMBERS = 20_000, 2

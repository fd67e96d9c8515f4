"""Every threshold that decides what a diagnosis says: its meaning, its unit and where its value comes from.

In this order: alarm and names; scores of candidates; views left out, halves of the views, ends of joint ranges;
effects in a model, added, kept or dropped; what looks alike, and what separates it; unmodelled effects of joints; those
in time; formulas (`stitch explain`).
"""

import numpy as np

# Family-wise error over all candidates (5 %, custom), shared between names and the alarm without one.
ALPHA = 0.05
ALPHA_NAME, ALPHA_UNKNOWN = 0.8 * ALPHA, 0.2 * ALPHA
# Log Bayes factor over "nothing is missing" that an alarm needs: 12 to 1, "positive" to "strong" (Kass & Raftery 1995).
LOG_BAYES_FACTOR = 2.5
# A name needs 20 to 1 over every other, and the unknown 20 to 1 over every name ("strong", Kass & Raftery 1995).
ODDS = float(np.log(20.0))
# Laws of the dictionary that are told together where views do not tell them apart: more help nobody (custom).
MOST_LAWS = 3
# Prior shares: nothing is missing, one effect of the library, something without a name (of every kind by itself).
PRIOR_NOTHING, PRIOR_PHYSICAL, PRIOR_UNKNOWN = 0.5, 0.45, 0.05
# The share of the laws of the dictionary, alike for each of some two hundred: an effect that was thought of before is
# some twenty times as likely as one of them (judgement).
PRIOR_LAWS = 0.3
# Probability with which the smallest detectable size is detected (custom in power analysis).
POWER = 0.8
# Squares in units of the scatter; an effect that needs more is of no plausible size: its prior holds back all of it.
UNDETECTABLE_SQUARE = 1e6
# No arm that is fit for use scatters more than this (rad, mm): several times the repeatability of data sheets
# (ISO 9283, 0.02 to 0.1 mm); larger is something systematic.
IMPLAUSIBLE = (2.5e-4, 0.12)
# Times the scatter of a usual flange and usual joints together, up to which what is left is that of an ordinary arm:
# the simulator's arms, with joints that scatter or without, leave 0.4 to 1.0 of it.
ORDINARY_SCATTER = 1.1

# A candidate is seen if one of its parameters, at its plausible size, is at least this many sigmas (custom).
SEEN_SIGMAS = 0.5
# A prior of this many plausible sizes is as good as none, and keeps the unseen finite.
FREE_SIZES = 30.0
# Forms so many nats behind the best one of their candidate add less than a per cent to it (e^-6 = 0.0025).
NEGLIGIBLE_NATS = 6.0
# Reduced observations beyond which variances are the same under both priors of sizes, and a fit takes half a second.
SETTLED_VARIANCES = 250
# Nats: forms that lose so many under the null's variances do not gain under their own either; under several variances,
# of which one is nearly that of the maximum, they gain half a nat at the most.
HOPELESS_GAIN, HOPELESS_GAIN_WITH_PRIOR = -4.0, -1.5
REFIT_GAIN_WITH_PRIOR = 0.5
# Numbers times forms that are fitted for a candidate (some seconds). With thousands of numbers the variances hardly
# move, and each fit takes a second: the best forms must do.
REFITTED_NUMBERS, FORMS_REFITTED_WITH_MANY_NUMBERS = 20_000, 2
# Views beyond which columns of candidates take a megabyte each, and all of them half a gigabyte.
MANY_POSES = 1000
# Effects that are sought at once, and candidates tried in earnest for each of them: what a minute allows.
MAX_JOINT_EFFECTS, CANDIDATES_TRIED = 6, 5
# Share of the largest gain below which a candidate is fitted only where nothing else can be named (time).
NEAR_BEST_GAIN = 0.5

# Smallest share of an effect that must remain when one view is left out.
MIN_STEADINESS = 0.25
# A p-value below which two halves of the views do not find one and the same: one right effect of a hundred is lost.
HALVES_P_VALUE = 0.01
# An effect must shorten the distances on views left out by more than a hundredth to stay in a model (mean square).
MAX_REMAINING_SHARE = 0.99**2
# Share of a plausible size, squared: what was not found has some size, or its prior would have none.
NEGLIGIBLE_SIZE = 1e-6
# Probability that a further end is predicted better: odds of three to one.
LIKELY_TO_HELP = 0.75
# Degrees of freedom of Student's t, and plausible sizes so wide that all views find what they can see.
END_PRIOR_FREEDOM, END_PRIOR_SIZES = 4.0, 10.0
# Candidates whose prediction on left-out views is computed; the others explain nothing.
CROSS_VALIDATED_CANDIDATES = 8

# New matches alone change a held-out residual by a few per cent: it rises if it does by more, and falls if below.
HELDOUT_RISE, HELDOUT_FALL = 1.05, 0.995
# An effect so many sigmas from zero is there although no residual shows it; below the second it can be dropped.
CLEAR_SIGMAS, FAINT_SIGMAS = 4.0, 2.0

# Effects whose patterns correlate more than this are aliases in these views; beyond the second they are listed as such.
ALIAS_CORRELATION, LISTED_ALIAS_CORRELATION = 0.9, 0.7
# Beyond this they are one and the same, whatever the views: what is left is rounding, and the prior's share.
SAME_CORRELATION = 0.999
# λ with P(correct) = Φ(√(λ/2)) = 0.95 between two effects.
SEPARATION_LAMBDA = 5.4
# p-value below which what is left is said to follow a covariate (custom), and bins that show the shape.
CLEAR_DEPENDENCE, DEPENDENCE_BINS = 0.01, 5

# Columns of a process at the most, and the share of its largest variance that the last of them has at least.
PROCESS_COLUMNS, PROCESS_LEAST_VARIANCE = 96, 1e-3
# Views (knots) whose covariance gives a process its shapes; the other views follow these (time: cubic).
PROCESS_KNOTS = 400
# Unmodelled joint effects whose size is sought with all variances, the likeliest (time).
JOINT_EFFECTS_FITTED = 12
# Multiples of the usual variance at which the search for an unmodelled effect's size begins.
UNMODELLED_VARIANCES = (0.01, 1.0, 30.0)
# Share of what a joint does so that a curve must carry to say where in the range it errs.
CURVE_LEAST_SHARE = 0.1

# Whole swings that a session must have seen, and swings per step: faster ones look like slower ones (Nyquist: 0.5).
LEAST_SWINGS, FASTEST_SWING = 2.0, 0.45
# Frequencies nearer to each other than half a swing over the session look alike; of a session with long breaks there
# would be thousands.
FREQUENCY_STEP, MOST_FREQUENCIES = 0.5, 150
# Standard deviation of the shortest stretch in steps, and of the longest as a share of the session; views in each.
SHORTEST_STRETCH, LONGEST_STRETCH, STRETCH_VIEWS = 1.5, 0.2, 2
# Trends whose size is sought with all variances, the likeliest (time); without a prior of pose errors the second.
TIME_EFFECTS_FITTED, TRENDS_FITTED = 3, 2
# Multiples of its own size that a process may have beside an effect.
TREND_SIZES = (1.0, 0.3, 0.1, 0.01)
# Joints for which a second one is sought that theirs may follow (time).
PAIRED_JOINTS = 2

# p-value of "no such formula" in the half of the views that took no part in finding it: below, it holds (custom).
CONFIRMED_FORMULA = 0.01
# Probability that an addend which is none is added, all of them counted (custom).
FALSE_ADDEND = 0.05
# rad; no gear, spring or clearance does more to a joint. Larger addends are differences of two that look alike.
LARGEST_JOINT_ADDEND = 0.01
# Plausible sizes beyond which nobody would believe a parameter of a formula.
FORMULA_LIMIT_SIZES = 10.0

"""What an answer must pass: shares of wrong alarms, odds, log evidence."""

import numpy as np

# Family-wise error over all candidates, shared between names and the alarm without one.
ALPHA = 0.05
ALPHA_NAME, ALPHA_UNKNOWN = 0.8 * ALPHA, 0.2 * ALPHA
# Log evidence over "nothing is missing" that an alarm needs: 12 to 1.
GAIN = 2.5
# A name needs 20 to 1 over every other, and the unknown 20 to 1 over every name.
ODDS = float(np.log(20.0))
# Probability with which the smallest detectable size is detected.
POWER = 0.8

"""From a coarse hand-eye to the fitted model: coarse, correct, fit; of surfaces and of labelled targets."""

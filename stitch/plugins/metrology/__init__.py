"""Numbers of a part with their uncertainty: features, budgets, calibration, and planning for them."""

"""Where model and measurements differ: the residual against everything that is known of it."""

"""Hand-eyes in closed form: A·X = X·B and A·X = Z·B."""

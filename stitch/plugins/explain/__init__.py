"""From unknown to a formula: what the unexplained follows, as an effect that a person can read, doubt and edit."""

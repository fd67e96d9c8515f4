"""Which effect is missing: candidates scored, evidence gathered, a verdict decided, plain sentences."""

"""Which effect is missing: candidates scored, a verdict selected and validated, the next view designed."""

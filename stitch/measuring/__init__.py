"""Numbers of a part with their uncertainty: features of a run, their budget, and an artefact that verifies them."""

"""From scores to a verdict: ranking, forward selection, backward elimination."""

"""What was seen as one linear model: overlapping surfaces, or labelled targets."""

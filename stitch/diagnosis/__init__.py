"""Which effect is missing: evidence counted in views, every candidate tried, aliases named, the next view proposed."""

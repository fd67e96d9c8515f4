"""From fitted poses to one cloud: register each view, find what supports a point, fuse."""

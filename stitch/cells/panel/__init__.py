"""A large panel held by six parallel robots: global model with a laser tracker, pose and shape."""

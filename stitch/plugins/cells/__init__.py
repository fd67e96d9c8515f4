"""The other measuring cells: each is a chain of frames that its own measurements close."""

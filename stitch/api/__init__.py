"""The library as people call it: arrays in, results out; all that the commands do, without a folder."""

"""The steps of a run: coarse, correct or fit, register, fuse; frozen data in, frozen data out."""

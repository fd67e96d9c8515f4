"""Pages and recordings of the other measuring cells; stitch finds them by entry points."""

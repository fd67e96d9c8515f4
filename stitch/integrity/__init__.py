"""Whether a session can be trusted: linkage of views, data snooping, pairing of rows, conventions of poses."""

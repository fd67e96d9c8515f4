"""Which views count: linkage, data snooping, pairing of rows, conventions of poses."""

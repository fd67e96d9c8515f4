"""The machine underneath: threads, native libraries, files that are there whole or not at all."""

"""A world whose truth is known, and the log that a rig would record in it."""

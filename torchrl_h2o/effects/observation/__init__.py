"""Effects on the way out: what sensors report of the simulator's state."""

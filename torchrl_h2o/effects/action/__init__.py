"""Effects on the way in: what the simulator executes of the action asked for."""

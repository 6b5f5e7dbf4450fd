"""Effects that are generalised forces, applied at every physics step."""

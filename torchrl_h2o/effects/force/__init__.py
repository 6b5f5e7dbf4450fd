"""Effects that are generalised forces."""

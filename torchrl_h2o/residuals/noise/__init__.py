"""Noise of the executed action: its estimate, and its place in an explanation."""

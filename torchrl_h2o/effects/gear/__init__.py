"""Effects of gears: friction that depends on load and speed, and play."""

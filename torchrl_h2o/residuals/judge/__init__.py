"""Held-out errors before and after effects are put in, their floor, and the two-sample test."""

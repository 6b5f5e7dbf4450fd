"""Errors before and after, on data that no fit has seen, and what they are measured against."""

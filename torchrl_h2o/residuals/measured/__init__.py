"""Measured transitions, their residuals, their noise, and the intervals disturbed from outside."""

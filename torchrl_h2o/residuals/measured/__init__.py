"""Measured transitions, their residuals, their sensor noise, and intervals disturbed from outside."""

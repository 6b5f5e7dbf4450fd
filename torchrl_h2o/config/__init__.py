"""Hydra configuration that the console commands and the recipes share."""

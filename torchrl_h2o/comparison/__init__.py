"""Grids of runs, files of results, scores over tasks, and the figures of the paper's tables."""

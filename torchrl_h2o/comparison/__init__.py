"""Compares methods: grids of runs, result files, scores over tasks, tables and figures."""

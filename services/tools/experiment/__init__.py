"""Experiments: grids of runs, with what they reached in one table."""

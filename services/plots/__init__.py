"""Figures and films of runs and episodes."""

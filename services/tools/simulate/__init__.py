"""Simulates many actors as replay sees them, without arenas and inference."""

"""Joining a run and keeping up with it: configuration, weights, statistics, lockstep."""

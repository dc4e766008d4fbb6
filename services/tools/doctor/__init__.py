"""Checks that this machine, and a run, have what a run needs."""

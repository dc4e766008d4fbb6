"""Looks whether this machine, and a run, have what a run needs."""

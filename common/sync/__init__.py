"""How a process joins a run and keeps up with it: configuration, weights, statistics."""

"""One folder a process; each `__main__` reads the configuration, wires by hand and runs."""

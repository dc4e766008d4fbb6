"""Process basics: signals, exit codes, atomic files, the heartbeat, names, versions."""

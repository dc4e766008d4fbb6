"""What every process needs: signals, files, the heartbeat, names."""

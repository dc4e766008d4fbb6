"""Messages between processes, their bytes, and the metrics."""

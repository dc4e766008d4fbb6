"""The messages that cross a process boundary, and their bytes."""

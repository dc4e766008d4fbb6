"""`mrcdrl replay inspect`: what the replay log of a run holds, read from its files."""

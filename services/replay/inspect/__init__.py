"""`mrcdrl replay inspect`: show what the replay log of a run holds, read from its files."""

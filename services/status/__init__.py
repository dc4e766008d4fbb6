"""`mrcdrl status`: shows a run that is up, and keeps its records where asked to."""

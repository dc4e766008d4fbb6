"""The processes of a run, one folder each, and the commands around them."""

"""What makes a learner step fast; `loss.py` is what it computes."""

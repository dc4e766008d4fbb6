"""The evaluator: judges live weights by the paper's test."""

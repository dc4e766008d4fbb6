"""The evaluator: evaluates live weights by the paper's test."""

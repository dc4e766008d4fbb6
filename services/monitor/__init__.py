"""A run as seen from outside: its state, rates, bottleneck, records and screen."""

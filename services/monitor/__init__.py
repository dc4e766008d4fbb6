"""A run as its watchers know it: state, rates, bottleneck, records, screen."""

"""The learner: pulls mini-batches, updates the network, publishes its weights."""

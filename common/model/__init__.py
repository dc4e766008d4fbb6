"""The Q-network, its weights, and the policy that acts by it."""

"""Fast implementations of the network's first layer, held to PyTorch's operations."""

"""The replay service: keeps transitions and serves mini-batches of them."""

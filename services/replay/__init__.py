"""The replay service: keeps transitions, and hands out mini-batches of them."""

"""The 2-D world: layouts, starts, physics, rewards, symmetries."""

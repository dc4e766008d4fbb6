"""The presets that `--config NAME` finds, and the router's configuration."""

"""Presets: `--config NAME` finds them here."""

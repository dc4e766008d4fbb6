"""What robots see: renderers, observation records, camera noise."""

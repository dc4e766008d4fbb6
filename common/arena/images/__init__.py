"""The robots' images: renderers, observation records, camera noise."""

"""The nouns that cross a process boundary, each declared once."""

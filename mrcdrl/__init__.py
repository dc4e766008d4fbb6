"""MRCDRL."""

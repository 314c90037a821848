"""The document: what is painted, as plain values."""

"""The design as plain values: painted strokes."""

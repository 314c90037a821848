"""Measurement: accuracy and speed, side by side. A leaf: the command line alone imports it."""

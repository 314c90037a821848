"""Procedural materials, drawn by family and seed."""

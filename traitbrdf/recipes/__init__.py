"""Procedural materials by family and seed."""

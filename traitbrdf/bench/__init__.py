"""Benchmarks: errors and times, measured against the reference."""

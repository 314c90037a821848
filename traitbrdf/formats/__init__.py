"""Bytes in and out, and nothing else: files, images, BRDF files, and what a screen shows."""

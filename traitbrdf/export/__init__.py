"""Designs for other programs: fits, textures, files."""

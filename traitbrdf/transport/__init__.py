"""From light to pixels: a linear operator, and its compression to a few images."""

"""A design shown live: preparation, cache, frames."""

"""Materials as points: the library, its embedding, traits and moves."""

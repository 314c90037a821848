"""Materials as points of a space: library, embedding, traits and moves."""

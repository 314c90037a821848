"""The scene: shapes, lights and a camera."""

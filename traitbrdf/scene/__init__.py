"""What is looked at: shapes, lights, a camera."""

"""Reading and writing files: images, BRDF files and arrays; and the tone curve for display."""

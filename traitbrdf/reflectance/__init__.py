"""What a surface does with light: tables, closed forms, measurements, descriptors."""

"""How a surface reflects light: tables, analytic models, measurements and descriptors."""

"""Recipes for the data that the package ships."""

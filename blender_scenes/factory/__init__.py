"""Small training scenes made by script from a seed: many, cheap and different."""

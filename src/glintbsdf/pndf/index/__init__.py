"""Inverted lists: for every normal, the places that may show it."""

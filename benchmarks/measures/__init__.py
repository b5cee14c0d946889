"""Measures are plain functions that return numbers. They do not judge."""

"""Whole scenes: rendering, inspection, denoising."""

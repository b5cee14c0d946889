"""What of a scene's lights is integrated rather than sampled."""

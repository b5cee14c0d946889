"""The classic filters of normal maps (Real-Time Rendering, section 9.13.1)."""

"""Independent checks: references, truth, plots, the suite that every BSDF passes."""

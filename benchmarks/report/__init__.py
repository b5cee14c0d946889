"""How the report of ``error_vs_time`` is shown: fronts, pictures, files, and the page."""

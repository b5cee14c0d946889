"""The report of ``error_vs_time``: Pareto fronts, figures, files, and the page."""

"""The parts of ``benchmarks/error_vs_time.py``: what is measured, how, and how it is shown."""

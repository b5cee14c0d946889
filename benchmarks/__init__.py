"""Benchmarks of glintbsdf: ``python -m benchmarks --help`` lists the commands.

``harness`` takes times, stores results and prints tables; ``cases`` has maps, footprints and
scenes; ``methods`` lists the methods to compare; ``measures`` are functions that return numbers;
``commands`` print tables of them; ``report`` draws figures and writes pages.
"""

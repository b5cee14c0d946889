"""Benchmarks of glintbsdf: ``python -m benchmarks --help`` lists the commands.

``harness`` times, keeps and shows; ``cases`` has maps, footprints and scenes; ``methods`` lists
what is compared; ``measures`` are plain functions that return numbers; ``commands`` print tables of
them; ``report`` draws pictures and writes pages.
"""

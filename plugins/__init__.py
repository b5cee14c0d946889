"""Mitsuba plugins, one module each, named after the plugin's type.

:mod:`glintbsdf.registration` imports these modules anew in each JIT variant.
"""

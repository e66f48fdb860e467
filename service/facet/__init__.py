"""Facet: scans with poses in, a live planar model of a building out."""

__version__ = "0.1.0"

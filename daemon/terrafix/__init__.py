"""Terrafix: a GPS receiver made of a camera and a map."""

__version__ = "0.1.0"

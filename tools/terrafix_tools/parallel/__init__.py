"""Pieces of work in several processes of this computer, or on a Dask cluster."""

"""Benchmarks of the relocalisation search."""

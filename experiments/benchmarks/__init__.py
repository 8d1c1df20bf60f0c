"""Timings, and comparisons with other programs."""

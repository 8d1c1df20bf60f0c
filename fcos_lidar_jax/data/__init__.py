"""Readers of point clouds and boxes."""

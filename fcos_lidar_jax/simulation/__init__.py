"""Simulated streets, seen by a ray-cast LiDAR. The same seed gives the same street."""

"""Seeded simulated worlds and a ray-cast LiDAR."""

"""A seeded simulated world, seen by a ray-cast LiDAR."""

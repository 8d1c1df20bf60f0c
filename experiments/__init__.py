"""What the paper asks, what was tried, and what it costs: scripts, run from the root of the repository."""

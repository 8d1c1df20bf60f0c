"""Pictures and reports. Matplotlib is imported on first use."""

"""Pictures, reports, and pages for a browser. Matplotlib is imported on first use."""

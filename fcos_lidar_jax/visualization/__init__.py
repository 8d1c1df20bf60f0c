"""Pictures and reports. Matplotlib is imported when one is drawn."""

"""The tables of the paper, a file each, and the scales and cells that they are trained by."""

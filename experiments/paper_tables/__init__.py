"""The tables of the paper, and the scales and cells to train them."""

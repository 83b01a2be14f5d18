"""How good predictions are: errors and densities summed up, the guard before them, and what others published."""

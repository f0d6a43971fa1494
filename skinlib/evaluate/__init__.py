"""How good skin weights are: metrics, the classical methods, and both side by side."""

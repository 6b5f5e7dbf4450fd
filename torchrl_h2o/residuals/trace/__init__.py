"""Search for effects of the catalogue that explain the residual: screening, fits, tests, alternatives."""

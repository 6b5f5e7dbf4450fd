"""Forces outside the catalogue: inverse dynamics of the residual, sparse regression, and the comparison."""

"""Forces that no catalogue holds, found in the residual by sparse regression."""

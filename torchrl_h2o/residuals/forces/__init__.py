"""Forces that no effect of the catalogue describes, as sums of terms in position, velocity, action and time."""

"""Console commands of the package: ``close-the-loop`` and ``h2o-evaluate``."""

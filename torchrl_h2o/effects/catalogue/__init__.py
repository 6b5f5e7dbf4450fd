"""The catalogue of a model: candidate effects that its simulator may lack, with trial values for their fits."""

from torchrl_h2o.effects.catalogue.catalogue import catalogue
from torchrl_h2o.effects.catalogue.entry import CatalogueEntry

__all__ = ["CatalogueEntry", "catalogue"]

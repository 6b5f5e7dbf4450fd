"""The catalogue of a model: every effect that its simulator may lack, with values to try first."""

from torchrl_h2o.effects.catalogue.catalogue import catalogue
from torchrl_h2o.effects.catalogue.entry import CatalogueEntry

__all__ = ["CatalogueEntry", "catalogue"]

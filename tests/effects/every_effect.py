"""All effects of the library."""

from torchrl_h2o import effects
from torchrl_h2o.effects import Effect

KINDS = {
    effects.ModelEffect,
    effects.VaryingEffect,
    effects.ActionEffect,
    effects.ForceEffect,
    effects.ObservationEffect,
}
EFFECTS = [
    member
    for member in vars(effects).values()
    if isinstance(member, type) and issubclass(member, Effect) and member not in KINDS | {Effect}
]

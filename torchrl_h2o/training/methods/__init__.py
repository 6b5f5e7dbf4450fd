"""The six methods of the paper's comparison and further ones, by name."""

from torchrl_h2o.training.methods.cql import CQL
from torchrl_h2o.training.methods.dara import DARA
from torchrl_h2o.training.methods.darc import DARC
from torchrl_h2o.training.methods.h2o import H2O
from torchrl_h2o.training.methods.h2o_plus import H2O_PLUS
from torchrl_h2o.training.methods.iql import IQL
from torchrl_h2o.training.methods.par import PAR
from torchrl_h2o.training.methods.rlpd import RLPD
from torchrl_h2o.training.methods.sac import SAC
from torchrl_h2o.training.methods.td3_bc import TD3_BC
from torchrl_h2o.training.methods.vgdf import VGDF
from torchrl_h2o.training.methods.weighted_td3 import WEIGHTED_TD3

METHODS = {
    "sac": SAC,  # simulator only
    "cql": CQL,  # real data only
    "iql": IQL,
    "td3_bc": TD3_BC,  # not in the paper
    "darc": DARC,  # simulator, with rewards corrected by real data
    "h2o": H2O,  # both
    "h2o_plus": H2O_PLUS,
    "rlpd": RLPD,  # both; not in the paper
    "td3": WEIGHTED_TD3,
    "par": PAR,
    "dara": DARA,
    "vgdf": VGDF,
}

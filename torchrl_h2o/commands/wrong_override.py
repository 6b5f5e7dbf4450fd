"""Hydra's errors about what is typed on the command line, in one line with the nearest name."""

from __future__ import annotations

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import ConfigKeyError

from torchrl_h2o.options.check import LISTED
from torchrl_h2o.options.nearest import did_you_mean

GROUPS = ["preset"]  # groups of files that are no entry of the configuration


def in_words(error: HydraException) -> str:
    """Returns what is wrong with an override and what is allowed.

    Args:
        error: an error of Hydra's composition. Those that are not about a single name keep Hydra's words.

    Examples:
        >>> in_words(MissingConfigException("not found", "env/halfcheeta", ["halfcheetah", "walker2d"]))
        'env=halfcheeta: must be halfcheetah or walker2d; did you mean halfcheetah?'
    """
    if isinstance(error, OverrideParseException):
        return f"{error.override}: cannot be read; write name=value, and quote a value that has special characters"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        *most, last = error.options
        return f"{group}={name}: must be {' or '.join([', '.join(most), last] if most else [last])}" + did_you_mean(
            name, error.options
        )
    if isinstance(cause := error.__cause__, ConfigKeyError | AttributeError) and "override" in str(error):
        return _unknown_option(cause)
    return str(error)


def _unknown_option(cause: Exception) -> str:
    name, node = str(getattr(cause, "full_key", "")), getattr(cause, "parent_node", None)
    folder = name.rpartition(".")[0]
    known = [f"{folder}.{key}".lstrip(".") for key in node or ()] + ([] if folder else GROUPS)
    return f"no option {name}{did_you_mean(name, known) or LISTED}"
